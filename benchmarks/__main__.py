"""Run the comparison: `python -m benchmarks [--quick] [--sets loss,cut] [--runs N] [--tables] [--fill]`.

Each finished cell is appended to the results at once; a cell that has `--runs` results is not run again, so the same
command continues an interrupted run.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.cells import QUICK, SETS, Cell, cells, measure
from benchmarks.link.laboratory import laboratory
from benchmarks.page import append_result, fill
from benchmarks.peers import PEERS, peer_called
from benchmarks.tables import report

RESULTS = Path(__file__).with_name("results") / "transports.jsonl"


def finished(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def wanted(arguments: argparse.Namespace) -> list[Cell]:
    names = arguments.sets.split(",") if arguments.sets else list(QUICK if arguments.quick else SETS)
    chosen = [cell for name in names for cell in cells(name)]
    if arguments.quick:
        chosen = [cell for cell in chosen if cell.name in QUICK.get(cell.set, (cell.name,))]
    return [cell for cell in chosen if (not arguments.peer or cell.peer in arguments.peer) and is_installed(cell.peer)]


def is_installed(peer: str) -> bool:
    """Whether the interpreter that a transport needs is there."""
    python = peer_called(peer).python
    return python is None or python.exists()


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="only the most informative cells")
    parser.add_argument("--sets", default="", help=f"comma-separated, of {', '.join(SETS)}")
    parser.add_argument("--peer", action="append", default=[], help="only this transport (repeatable)")
    parser.add_argument("--runs", type=int, default=1, help="number of runs of each cell; tables show the median")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--fill", action="store_true", help="write the tables to docs/benchmarks.md")
    parser.add_argument("--tables", action="store_true", help="only print the tables of existing results")
    arguments = parser.parse_args()
    results = finished(arguments.results)
    if missing := [name for name in PEERS if not is_installed(name)]:
        print(f"left out, because scripts/setup-ros2 has not run: {', '.join(missing)}", file=sys.stderr)
    if not arguments.tables:
        arguments.results.parent.mkdir(parents=True, exist_ok=True)
        known = Counter((r["set"], r["peer"], r["name"]) for r in results)
        chosen = wanted(arguments)
        # round by round, so that the runs of a cell are spread over time
        todo = [
            cell for turn in range(arguments.runs) for cell in chosen if known[cell.set, cell.peer, cell.name] <= turn
        ]
        with laboratory(2) as lab:
            for number, cell in enumerate(todo, 1):
                print(f"[{number}/{len(todo)}] {cell.set}: {cell.name}: {cell.peer}", file=sys.stderr, flush=True)
                result = measure(lab, cell)
                results.append(result)
                append_result(arguments.results, result)
    print(report(results))
    if arguments.fill:
        fill("tables", report(results))


if __name__ == "__main__":
    main()
