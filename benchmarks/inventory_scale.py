"""Scaling of load, lint and render with fleet size: `python -m benchmarks.inventory_scale [--nodes 10,100] [--json]`.

For each size an inventory is written with an entry for every node (address, MAC, serial, label; 50 nodes per mesh), and
each step is timed on it in a separate process, so that sizes do not share caches or memory. A step's time is CPU time,
the best of several runs; the growth is its time per node relative to the smallest fleet of at least a hundred nodes.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import platform
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from meshctl.diagnostics import Severity
from meshctl.inventory import load, load_fleet
from meshctl.lint import DiskFiles, LintContext, check_path, lint
from meshctl.model import Secret
from meshctl.regdb import load as load_regdb
from meshctl.render import render_nodes

SIZES = (10, 100, 1_000, 10_000)
# about the largest mesh that one channel supports
NODES_PER_MESH = 50

_HEAD = """\
meshctl: 1
fleet: scale
country: US
operators: {ssh_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIFCutyt+xTdKa5I6TRfbIza4ho4hbhlYM4e+/swgNX9L scale"]}
hardware:
  rocket:
    board: ubnt,rocket-m
    profile: ubnt_rocket-m
    target: ath79/generic
    release: "24.10"
    lan_ports: [eth0]
    radios:
      radio0:
        path: pci0000:00/0000:00:00.0
        band: 2g
        rated_power_dbm: 30
        max_drive_dbm: 30
        antenna_gain_dbi: 5
    recovery: Hold reset at power-on.
defaults: {hardware: rocket, state: carried, role: beacon}
"""


@dataclass(frozen=True, slots=True)
class Measured:
    """CPU seconds for one fleet: `rules_s` for lint's rules alone, `lint_s` for all of `meshctl lint`; `findings` are
    its errors and warnings, `peak_mib` is the peak memory of the process."""

    nodes: int
    file_kib: int
    load_s: float
    rules_s: float
    lint_s: float
    render_s: float
    findings: int
    peak_mib: int


def inventory(nodes: int) -> str:
    """An inventory of `nodes` nodes, one entry each; the first node of each mesh is a base."""
    meshes, groups, entries = ["meshes:"], ["groups:"], ["nodes:"]
    for number in range(nodes):
        mesh, place = divmod(number, NODES_PER_MESH)
        network = f"10.{mesh // 256}.{mesh % 256}"
        if place == 0:
            bssid = f"02:ca:fe:00:{mesh // 256:02x}:{mesh % 256:02x}"
            channel = (1, 6, 11)[mesh % 3]
            meshes.append(
                f"  m{mesh:04}: {{ssid: scale-{mesh:04}, bssid: {bssid}, band: 2g, channel: {channel}, "
                f"network: {network}.0/24}}"
            )
            groups.append(f"  g{mesh:04}: {{radios: {{radio0: {{mesh: m{mesh:04}, tx_power_dbm: 27}}}}}}")
        high, low = divmod(number, 256)
        entries.append(
            f"  n{number:06}:\n"
            f"    groups: [g{mesh:04}]\n"
            f"    role: {'base' if place == 0 else 'beacon'}\n"
            f"    address: {network}.{place + 1}\n"
            f"    label: L{number}\n"
            f"    serial: S{number:08}\n"
            f"    mac: 02:00:00:00:{high:02x}:{low:02x}"
        )
    return "\n".join((_HEAD + meshes[0], *meshes[1:], *groups, *entries)) + "\n"


def measure(nodes: int) -> Measured:
    """Time every step on one fleet, in this process."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, "fleet.yaml")
        path.write_text(inventory(nodes))
        runs = 3 if nodes <= 1_000 else 1
        load_s = _best(lambda: load(path), runs)
        fleet = load_fleet(path)
        regdb = load_regdb()
        context = LintContext(regdb, DiskFiles())
        rules_s = _best(lambda: lint(fleet, context), runs)
        lint_s = _best(lambda: check_path(path, regdb, {}), runs)
        found = lint(fleet, context)
        names = list(fleet.nodes)
        render_s = _best(lambda: render_nodes(fleet, names, lambda _: Secret("unused")), runs)
        return Measured(
            nodes=nodes,
            file_kib=path.stat().st_size // 1024,
            load_s=load_s,
            rules_s=rules_s,
            lint_s=lint_s,
            render_s=render_s,
            findings=sum(item.severity is not Severity.NOTE for item in found),
            peak_mib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        )


def _best(step: Callable[[], object], runs: int) -> float:
    times = []
    for _ in range(runs):
        begin = time.process_time()
        step()
        times.append(time.process_time() - begin)
    return min(times)


def table(results: list[Measured]) -> str:
    """Markdown: seconds, and in brackets the time per node relative to the reference."""
    reference = next((result for result in results if result.nodes >= 100), results[0])

    def cell(result: Measured, step: str) -> str:
        seconds, base = getattr(result, step), getattr(reference, step)
        growth = (seconds / result.nodes) / (base / reference.nodes)
        return f"{seconds:.3f} ({growth:.2f})"

    steps = ("load", "rules", "lint", "render")
    heads = ("nodes", "file, KiB", *(f"{step}, s (growth)" for step in steps), "findings", "peak, MiB")
    lines = [f"| {' | '.join(heads)} |", f"|{' ---: |' * len(heads)}"]
    for result in results:
        times = " | ".join(cell(result, f"{step}_s") for step in steps)
        lines.append(f"| {result.nodes} | {result.file_kib} | {times} | {result.findings} | {result.peak_mib} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.inventory_scale", description=__doc__)
    parser.add_argument("--nodes", default=",".join(map(str, SIZES)), help="sizes, separated by commas")
    parser.add_argument("--json", action="store_true", help="print JSON lines instead of a table")
    arguments = parser.parse_args()
    results = []
    for size in map(int, arguments.nodes.split(",")):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            results.append(pool.apply(measure, (size,)))
        print(f"{size} nodes: done", file=sys.stderr, flush=True)
    if arguments.json:
        for result in results:
            print(json.dumps(asdict(result)))
    else:
        print(f"Python {platform.python_version()}, {platform.machine()}, processor seconds on one core\n")
        print(table(results))


if __name__ == "__main__":
    main()
