"""Independent meshes changed in one run: `python -m benchmarks.meshes [--meshes 1,10,50] [--results FILE] [--tables]
[--fill]`.

Each mesh is a chain of four model nodes (`benchmarks.model_node`: a real dropbear each, at a router's pace) behind a
base of its own; `meshctl provision` changes all of them, at most one node of a mesh at a time. Model nodes stay
reachable while others change.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.model_node.fleet import INVENTORY, VARIANTS, ModelFleet
from benchmarks.page import append_result, fill, read_results, this_machine
from benchmarks.provisioning import limit_s, ran, sizes_of

RESULTS = Path(__file__).with_name("results") / "meshes.jsonl"
NODES = 4


class MeshFleet(ModelFleet):
    """Model nodes in the order of their meshes; the first one of each is its base."""

    def __init__(self, directory: Path, meshes: int) -> None:
        super().__init__(directory, meshes * NODES, is_chain=True)

    def chain_of(self, number: int) -> list[int]:
        first = number - (number - 1) % NODES
        return [number, first, first + NODES - 1]

    def _write_inventories(self, parallel: int | None) -> None:
        super()._write_inventories(parallel)
        head, _, _ = INVENTORY.partition("meshes:")
        head = head.replace("max_down: 1000", "max_down: 1")
        for number, variant in enumerate(VARIANTS):
            text = head.format(key=f"{self._public} benchmark", log_size=64 + number, policy="", distance=0, penalty=0)
            names = [f"m{index:02}" for index in range(len(self.names) // NODES)]
            text += "meshes:\n"
            for name in names:
                # the cell that model nodes report
                text += (
                    f'  {name}: {{ssid: proof, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, '
                    f"network: 10.42.0.0/16, distance_m: {1000 + number}}}\n"
                )
            text += f"sites: {{{', '.join(f'{name}: {{}}' for name in names)}}}\n"
            text += "defaults: {hardware: box, state: deployed, role: beacon}\nnodes:\n"
            for index, (node, port) in enumerate(self.ports.items()):
                mesh, role = names[index // NODES], "role: base, " if index % NODES == 0 else ""
                address = f"10.42.{1 + (index + 1) // 250}.{1 + (index + 1) % 250}"
                text += (
                    f"  {node}: {{{role}address: {address}, site: {mesh}, radios: {{radio0: {{mesh: {mesh}}}}}, "
                    f"ssh: {{host: 127.0.0.1, port: {port}}}}}\n"
                )
            self.inventory(variant).write_text(text, encoding="utf-8")


def measure(meshes: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="meshes-") as directory:
        fleet = MeshFleet(Path(directory), meshes)
        command = [sys.executable, "-m", "meshctl", "provision", "--yes", "--json", "-i", str(fleet.inventory("b"))]
        with fleet.running():
            took = ran([*command, "--key", str(fleet.key)], fleet.environ, limit_s(meshes * NODES))
    return {"meshes": meshes, **took, **this_machine()}


def table(results: Sequence[Mapping[str, Any]]) -> str:
    lines = ["| meshes | nodes | seconds | processor seconds per node |", "| ---: | ---: | ---: | ---: |"]
    for each in results:
        nodes = each["meshes"] * NODES
        lines.append(f"| {each['meshes']} | {nodes} | {each['seconds']:.1f} | {each['cpu_s'] / nodes:.3f} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.meshes", description=__doc__)
    parser.add_argument("--meshes", default="1,10,50", help="numbers of meshes")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    if not arguments.tables:
        for count in sizes_of(arguments.meshes):
            result = measure(count)
            append_result(arguments.results, result)
            print(table([result]), flush=True)
    latest = {result["meshes"]: result for result in read_results(arguments.results)}
    text = table([latest[key] for key in sorted(latest)])
    print(text)
    if arguments.fill:
        fill("meshes", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
