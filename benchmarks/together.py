"""A chain changed in order and together: `python -m benchmarks.together [--nodes 2,10] [--results FILE] [--tables]`.

Virtual nodes in a chain (each hears the one before and the one after it) are changed from configuration `a` to `b` in
order, and back with `--together`, by `meshctl provision` with its defaults. All nodes run on this machine, so wall time
includes them. The plan's own estimate of both ways, made before, is printed beside.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.provisioning import limit_s, ran
from tests.meshctl.proof.rig import Rig

RESULTS = Path(__file__).with_name("results") / "together.jsonl"
WINDOW_S = 120


def measure(count: int) -> dict[str, Any]:
    """Both ways on a chain of `count` nodes, the base included."""
    with (
        tempfile.TemporaryDirectory(prefix="together-") as directory,
        Rig(Path(directory), count - 1, window_s=WINDOW_S, parallel=None, is_chain=True) as rig,
    ):
        taken = rig.take_in("a")
        if taken.code:
            raise RuntimeError(f"cannot bootstrap the chain:\n{taken.out}{taken.err}")
        in_order = _provision(rig, "b", count)
        planned = json.loads(rig.meshctl("plan", "a", "--json").out)
        together = _provision(rig, "a", count, "--together")
    estimates = {way["name"]: way["estimated_s"] for way in planned["ways"]}
    recommended = [way["name"] for way in planned["ways"] if way["recommended"]]
    return {
        "nodes": count,
        "in_order": {**in_order, "estimated_s": estimates["in order"]},
        "together": {**together, "estimated_s": estimates["together"]},
        "recommended": recommended[0],
    }


def _provision(rig: Rig, variant: str, count: int, *options: str) -> dict[str, float]:
    command = [sys.executable, "-m", "meshctl", "provision", "--yes", "--json", *options]
    command += ["-i", str(rig.inventory(variant)), "--key", str(rig.directory / "key")]
    return ran(command, rig.environ, limit_s(count))


def table(results: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        "| nodes in the chain | way | seconds | estimated by the plan | processor seconds per node |",
        "| ---: | --- | ---: | ---: | ---: |",
    ]
    for result in results:
        for way, name in (("in_order", "in order"), ("together", "together")):
            took = result[way]
            mark = " (recommended)" if result["recommended"] == name else ""
            lines.append(
                f"| {result['nodes']} | {name}{mark} | {took['seconds']:.1f} | {took['estimated_s']:.0f} "
                f"| {took['cpu_s'] / result['nodes']:.3f} |"
            )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.together", description=__doc__)
    parser.add_argument("--nodes", default="2,10", help="lengths of the chains")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    arguments = parser.parse_args()
    if not arguments.tables:
        for count in map(int, arguments.nodes.split(",")):
            result = measure(count)
            arguments.results.parent.mkdir(parents=True, exist_ok=True)
            with arguments.results.open("a") as file:
                file.write(json.dumps(result) + "\n")
            print(table([result]), flush=True)
    lines = arguments.results.read_text().splitlines() if arguments.results.exists() else []
    latest = {result["nodes"]: result for result in map(json.loads, lines)}
    print(table([latest[count] for count in sorted(latest)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
