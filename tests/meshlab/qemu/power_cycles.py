"""`python -m tests.meshlab.qemu.power_cycles`: nodes with the kernel's radios lose their power, several at once and at
any moment, until it happened `--cycles` times. Each must come back by itself, and its mesh must meet it.

Each round is written to `--out`; an earlier run's rounds there count. `--fill PAGE` writes the table into the page. A
node that does not come back ends the run, with the console of every node.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.page import append_result, fill, read_results
from meshlab.errors import LabError
from tests.meshlab.fleet_report import report
from tests.meshlab.power_cycles import WAYS, cycle
from tests.meshlab.qemu.conftest import INVENTORY, WAIT_S, Lab, field_lab

PAGE = Path(__file__).parents[3] / "docs" / "proof.md"
SECTION = "power cycles"


def main() -> int:
    """Run the cycles that are missing; 1 if a node does not come back."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.meshlab.qemu.power_cycles",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--cycles", type=int, default=1000, help="how often nodes lose their power, over all runs")
    parser.add_argument("--seed", type=int, help="of the random choices; default: the number of rounds in --out")
    parser.add_argument("--out", type=Path, default=Path("power-cycles.jsonl"), help="where each round is written")
    parser.add_argument("--fill", type=Path, nargs="?", const=PAGE, help="write the table into this page; run nothing")
    chosen = parser.parse_args()
    earlier = read_results(chosen.out)
    if chosen.fill is not None:
        fill(SECTION, table(earlier), chosen.fill)
        return 0
    left = chosen.cycles - sum(map(_cycles, earlier))
    if left <= 0:
        sys.stdout.write(f"{table(earlier)}\n")
        return 0
    seed = len(earlier) if chosen.seed is None else chosen.seed
    with tempfile.TemporaryDirectory(prefix="power-cycles-") as home, field_lab(Lab, INVENTORY, Path(home)) as lab:
        failure = _run(lab, random.Random(seed), left, chosen.out)
    sys.stdout.write(f"{table(read_results(chosen.out))}\n")
    return 1 if failure else 0


def _run(lab: Lab, dice: random.Random, left: int, out: Path) -> bool:
    try:
        for one in cycle(lab.fleet, lab.NODES, left, dice, wait_s=WAIT_S, met=lab.meet):
            record = {"at_s": round(time.time()), "down": len(one.down), "cycles": one.cycles, "took_s": one.took_s}
            append_result(out, record)
        lab.settle()
    except (AssertionError, LabError) as error:
        append_result(out, {"at_s": round(time.time()), "failure": str(error)})
        sys.stderr.write(f"{error}\n{report(lab.fleet, ' '.join(lab.NODES))}\n")
        return True
    return False


def _cycles(result: Mapping[str, Any]) -> int:
    return sum(result.get("cycles", {}).values())


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """How often nodes went down in each way, in how many rounds, and how often one did not come back."""
    by_way: Counter[str] = Counter()
    for result in results:
        by_way.update(result.get("cycles", {}))
    done = [result for result in results if "cycles" in result]
    failures = [result for result in results if "failure" in result]
    lines = ["| way | power cycles |", "| --- | ---: |"]
    lines += [f"| {way} | {by_way[way]} |" for way in WAYS]
    lines += [f"| all | {by_way.total():,} |", ""]
    down = [result["down"] for result in done]
    longest_s = max((result["took_s"] for result in done), default=0.0)
    lines.append(
        f"{len(done)} rounds, in which up to {max(down, default=0)} nodes went down together. {sum(down)} came back, "
        f"after {longest_s:.0f} s at most; {len(failures)} times a node did not, or its mesh did not meet it."
    )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
