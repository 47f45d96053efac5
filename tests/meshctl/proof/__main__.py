"""`python -m tests.meshctl.proof`: run the proofs, write every case to a JSONL file, print the tables.

Parts: apply, kill, flash, flash-kill, crowd. `--minutes` ends a part early. The next call with the same file, `--nodes`
and `--every` continues after the last batch in it of this version of the dead-man script. `--table FILE` prints the
tables of earlier runs, and with `--fill PAGE` puts their rows there, in place of those of the same operation and fault.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, TextIO

from meshctl.device.deadman import version
from tests.meshctl.proof.crowd import hurt_and_provision
from tests.meshctl.proof.kills import Case
from tests.meshctl.proof.matrix import apply_matrix, filled, firmware, flash_matrix, kill_matrix, table
from tests.meshctl.proof.rig import Rig

PARTS = ("apply", "kill", "flash", "flash-kill", "crowd")
# Every one of them tells about ten words in a flash; two at once show what the other one's step does to it.
FLASHED_AT_ONCE = 2


def main() -> int:
    """Run the chosen parts; 1 when a case does not hold."""
    parser = argparse.ArgumentParser(prog="python -m tests.meshctl.proof", description=__doc__)
    parser.add_argument("parts", nargs="*", default=[], help=f"which of {', '.join(PARTS)}; default: all")
    parser.add_argument("--out", type=Path, default=Path("proof.jsonl"), help="where each case is written")
    parser.add_argument("--nodes", type=int, default=8, help="nodes struck at once")
    parser.add_argument("--crowd", type=int, default=200, help="nodes of the big fleet")
    parser.add_argument("--every", type=int, default=1, help="strike at every so many steps")
    parser.add_argument("--first", type=int, default=0, help="begin at this batch, or word of meshctl (kills)")
    parser.add_argument("--minutes", type=float, default=math.inf, help="begin nothing more after so many (not crowd)")
    parser.add_argument("--table", type=Path, help="print the tables of this file, run nothing")
    parser.add_argument("--fill", type=Path, help="with --table: the page to put its rows into")
    chosen = parser.parse_args()
    if chosen.table is not None:
        return _report(chosen.table, chosen.fill)
    with chosen.out.open("a", encoding="utf-8") as out, tempfile.TemporaryDirectory(prefix="proof-") as home:
        for part in chosen.parts or PARTS:
            _run(part, chosen, out, Path(home) / part)
    return _report(chosen.out)


def _run(part: str, chosen: argparse.Namespace, out: TextIO, directory: Path) -> None:
    def write(record: dict[str, Any]) -> None:
        out.write(json.dumps(record) + "\n")
        out.flush()

    def tell(case: Case, phase: str, batch: int) -> None:
        record = {"part": part, "phase": phase, "batch": batch, "version": version(), "at_s": round(time.time())}
        write({**record, **case.object()})
        if not case.holds:
            sys.stderr.write(f"does not hold: {case}\n")

    deadline = time.monotonic() + 60.0 * chosen.minutes
    first = chosen.first or next_batch(chosen.out, part, chosen.every if "kill" in part else 1)
    where = {"every": chosen.every, "first": first, "is_enough": lambda: time.monotonic() > deadline}
    following = 0
    match part:
        case "apply":
            with Rig(directory, chosen.nodes) as rig:
                _take_in(rig)
                following = apply_matrix(rig, tell, **where)
        case "kill":
            with Rig(directory, chosen.nodes) as rig:
                _take_in(rig)
                following = kill_matrix(rig, tell, **where)
        case "flash":
            with Rig(directory, chosen.nodes, firmware=firmware(directory)) as rig:
                _take_in(rig)
                following = flash_matrix(rig, tell, first=first, is_enough=where["is_enough"])
        case "flash-kill":
            with Rig(directory, FLASHED_AT_ONCE, firmware=firmware(directory)) as rig:
                _take_in(rig)
                following = kill_matrix(rig, tell, verb="flash", **where)
        case "crowd":
            with Rig(directory, chosen.crowd) as rig:
                began = time.monotonic()
                _take_in(rig)
                taken = {"bootstrap_s": round(time.monotonic() - began, 1)}
                write({"part": part, **taken, **hurt_and_provision(rig, share=0.05, old="a", new="b")})
        case _:
            raise SystemExit(f"no part is called {part!r}: expected {', '.join(PARTS)}")
    if following:
        sys.stderr.write(f"{part}: go on with --first {following}\n")


def next_batch(path: Path, part: str, step: int) -> int:
    """The batch after the last one of this part in the file, of this version."""
    records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    done = [one["batch"] for one in records if (one["part"], one.get("version")) == (part, version())]
    return max(done) + step if done else 1


def _take_in(rig: Rig) -> None:
    taken = rig.take_in("a")
    if taken.code != 0:
        raise SystemExit(f"the fleet could not be taken in: {taken.out} {taken.err}")


def _report(path: Path, page: Path | None = None) -> int:
    records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    cases = [record for record in records if record["part"] != "crowd"]
    if page is not None:
        page.write_text(filled(page.read_text(encoding="utf-8"), table(cases)), encoding="utf-8")
    sys.stdout.writelines(f"{line}\n" for line in table(cases))
    for record in records:
        if record["part"] == "crowd":
            sys.stdout.write(json.dumps(record, indent=1) + "\n")
    bad = [record for record in cases if not record["holds"]]
    bad += [record for record in records if record["part"] == "crowd" and (record["wrong"] or record["not new"])]
    missed = sum(not record.get("struck", True) for record in cases)
    sys.stdout.write(f"{len(cases) - missed} cases, {len(bad)} failed; {missed} more ended before their step\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
