"""The guide on sweeps runs: every command of its `sh` blocks, in order, in one directory."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "docs" / "how-to" / "sweep-missions.md"


def test_the_commands_of_the_guide_run(tmp_path: Path) -> None:
    blocks = re.findall(r"^```sh\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 4
    (tmp_path / "inventory").symlink_to(ROOT / "inventory")
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", "-eu"],
        input="".join(blocks),
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("10 of 12 cases have a result already") == 1
    assert "12 runs of scenario partition-soak" in done.stdout
    assert "runs with topics.estop.latency_p99_s<=0.1" in done.stdout
    assert "beacons.b02.drop_s=99 trial.route_s=10" in done.stdout
    assert "</html>" in (tmp_path / "soak.html").read_text(encoding="utf-8")
