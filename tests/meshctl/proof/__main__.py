"""`python -m tests.meshctl.proof`: run the proofs, write every case to a JSONL file, print the tables.

Parts: apply, kill, flash, flash-kill, crowd. `--table FILE` prints the tables of an earlier run.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, TextIO

from tests.meshctl.proof.crowd import hurt_and_provision
from tests.meshctl.proof.kills import Case
from tests.meshctl.proof.matrix import apply_matrix, firmware, flash_matrix, kill_matrix, table
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
    parser.add_argument("--first", type=int, default=1, help="begin at this word of meshctl (kill, flash-kill)")
    parser.add_argument("--table", type=Path, help="print the tables of this file, run nothing")
    chosen = parser.parse_args()
    if chosen.table is not None:
        return _report(chosen.table)
    with chosen.out.open("a", encoding="utf-8") as out, tempfile.TemporaryDirectory(prefix="proof-") as home:
        for part in chosen.parts or PARTS:
            _run(part, chosen, out, Path(home) / part)
    return _report(chosen.out)


def _run(part: str, chosen: argparse.Namespace, out: TextIO, directory: Path) -> None:
    def write(record: dict[str, Any]) -> None:
        out.write(json.dumps(record) + "\n")
        out.flush()

    def tell(case: Case, phase: str) -> None:
        write({"part": part, "phase": phase, "at_s": round(time.time()), **case.object()})
        if not case.holds:
            sys.stderr.write(f"does not hold: {case}\n")

    match part:
        case "apply":
            with Rig(directory, chosen.nodes) as rig:
                _take_in(rig)
                apply_matrix(rig, tell, every=chosen.every)
        case "kill":
            with Rig(directory, chosen.nodes) as rig:
                _take_in(rig)
                kill_matrix(rig, tell, every=chosen.every, first=chosen.first)
        case "flash":
            with Rig(directory, chosen.nodes, firmware=firmware(directory)) as rig:
                _take_in(rig)
                flash_matrix(rig, tell)
        case "flash-kill":
            with Rig(directory, FLASHED_AT_ONCE, firmware=firmware(directory)) as rig:
                _take_in(rig)
                kill_matrix(rig, tell, every=chosen.every, first=chosen.first, verb="flash")
        case "crowd":
            with Rig(directory, chosen.crowd) as rig:
                began = time.monotonic()
                _take_in(rig)
                first = {"bootstrap_s": round(time.monotonic() - began, 1)}
                write({"part": part, **first, **hurt_and_provision(rig, share=0.05, old="a", new="b")})
        case _:
            raise SystemExit(f"no part is called {part!r}: expected {', '.join(PARTS)}")


def _take_in(rig: Rig) -> None:
    taken = rig.take_in("a")
    if taken.code != 0:
        raise SystemExit(f"the fleet could not be taken in: {taken.out} {taken.err}")


def _report(path: Path) -> int:
    records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    cases = [record for record in records if record["part"] != "crowd"]
    sys.stdout.writelines(f"{line}\n" for line in table(cases))
    for record in records:
        if record["part"] == "crowd":
            sys.stdout.write(json.dumps(record, indent=1) + "\n")
    bad = [record for record in cases if not record["holds"]]
    bad += [record for record in records if record["part"] == "crowd" and (record["wrong"] or record["not new"])]
    sys.stdout.write(f"{len(cases)} cases, {len(bad)} do not hold\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
