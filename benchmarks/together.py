"""A chain changed in order and together: `python -m benchmarks.together [--nodes 6] [--model 50] [--results FILE]
[--tables] [--fill]`.

The nodes of a chain (each hears the one before and the one after it) are changed from configuration `a` to `b` in
order, and back with `--together`, by `meshctl provision` with its defaults. The plan's own estimate of both ways, made
between the two, is printed beside.

`--nodes`: virtual nodes of these numbers; all of them run on this machine and wall time includes them. `--model`: model
nodes (`benchmarks.model_node`), which answer at the pace of a router and cost this machine almost nothing. A model node
stays reachable while others change.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.model_node.fleet import ModelFleet
from benchmarks.page import append_result, fill, read_results
from benchmarks.provisioning import limit_s, ran, sizes_of
from tests.meshctl.proof.rig import Rig

RESULTS = Path(__file__).with_name("results") / "together.jsonl"
WINDOW_S = 120


def measure(count: int) -> dict[str, Any]:
    """Both ways on a chain of `count` virtual nodes, the base included."""
    with (
        tempfile.TemporaryDirectory(prefix="together-") as directory,
        Rig(Path(directory), count - 1, window_s=WINDOW_S, parallel=None, is_chain=True) as rig,
    ):
        taken = rig.take_in("a")
        if taken.code:
            raise RuntimeError(f"cannot bootstrap the chain:\n{taken.out}{taken.err}")
        return _both_ways("virtual", count, rig.inventory, rig.directory / "key", rig.environ)


def measure_model(count: int) -> dict[str, Any]:
    """Both ways on a chain of `count` model nodes."""
    with tempfile.TemporaryDirectory(prefix="together-") as directory:
        fleet = ModelFleet(Path(directory), count, is_chain=True)
        with fleet.running():
            return _both_ways("model", count, fleet.inventory, fleet.key, fleet.environ)


def _both_ways(
    fleet: str, count: int, inventory: Callable[[str], Path], key: Path, environ: Mapping[str, str]
) -> dict[str, Any]:
    def meshctl(verb: str, variant: str, *options: str) -> list[str]:
        command = [sys.executable, "-m", "meshctl", verb, *options, "--json", "-i", str(inventory(variant))]
        return [*command, "--key", str(key)]

    in_order = ran(meshctl("provision", "b", "--yes"), environ, limit_s(count))
    planned = subprocess.run(
        meshctl("plan", "a"), env=dict(environ), capture_output=True, text=True, check=False, timeout=limit_s(count)
    )
    ways = json.loads(planned.stdout)["ways"]
    together = ran(meshctl("provision", "a", "--yes", "--together"), environ, limit_s(count))
    estimates = {way["name"]: way["estimated_s"] for way in ways}
    return {
        "fleet": fleet,
        "nodes": count,
        "in_order": {**in_order, "estimated_s": estimates["in order"]},
        "together": {**together, "estimated_s": estimates["together"]},
        "recommended": next(way["name"] for way in ways if way["recommended"]),
    }


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
                f"| {result['nodes']} {result['fleet']} | {name}{mark} | {took['seconds']:.1f} "
                f"| {took['estimated_s']:.0f} | {took['cpu_s'] / result['nodes']:.3f} |"
            )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.together", description=__doc__)
    parser.add_argument("--nodes", default="6", help="lengths of the chains of virtual nodes; empty for none")
    parser.add_argument("--model", default="50", help="lengths of the chains of model nodes; empty for none")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    if not arguments.tables:
        sizes = [(measure_model, count) for count in sizes_of(arguments.model)]
        sizes += [(measure, count) for count in sizes_of(arguments.nodes)]
        for run, count in sizes:
            result = run(count)
            append_result(arguments.results, result)
            print(table([result]), flush=True)
    latest = {(result["fleet"], result["nodes"]): result for result in read_results(arguments.results)}
    text = table([latest[key] for key in sorted(latest)])
    print(text)
    if arguments.fill:
        fill("together", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
