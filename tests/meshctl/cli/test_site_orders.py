"""What sites replace whose orders waited: it comes with the events of all of them, at the same time."""

from __future__ import annotations

import base64
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier
from types import SimpleNamespace
from typing import Any

from meshctl.cli.site_orders import LateReplaced
from meshctl.fleet.run_files import BEFORE, RunFiles
from meshctl.model import Site
from meshctl.sites.dispatch import SiteRun
from meshctl.sites.envelope import ReplyKey, sealed_for_reply

_SITES = 16


def test_what_sites_report_at_the_same_time_is_kept_of_each(tmp_path: Path) -> None:
    opened: Any = SimpleNamespace(journal=SimpleNamespace(path=tmp_path / "journal.sqlite"))
    entry: Any = SimpleNamespace(id=7)
    late = LateReplaced(opened, entry)
    runs = [SiteRun(Site(f"s{number}"), f"r{number}", (f"n{number}",)) for number in range(_SITES)]
    keys = {run.run: ReplyKey.new() for run in runs}
    late.expect(keys)
    together = Barrier(_SITES)

    def report(run: SiteRun) -> None:
        replaced = json.dumps({run.nodes[0]: {"files": run.run}, "of another site": {}}).encode()
        sealed = base64.b64encode(sealed_for_reply(replaced, keys[run.run].recipient)).decode()
        together.wait()
        late.keep(run, sealed)

    with ThreadPoolExecutor(_SITES) as pool:
        list(pool.map(report, runs))
    assert RunFiles(opened.journal.path).load(7, BEFORE) == {run.nodes[0]: {"files": run.run} for run in runs}
