"""Urgent messages beside a lidar that broadcasts on the robot's LAN: `python -m benchmarks.lan_filter [--fill]`.

The lab's example fleet is provisioned on the kernel's 802.11 radios with a LAN filter on rover2's radio. The base's
link has a limited rate, and its broadcasts a quarter of it, as with a low basic rate. Then, in each run:

    no lidar -> lidar to a device on the robot, filter on -> lidar to 255.255.255.255, filter on -> the same, filter off

and in each of the four, rover2's computer pings the operator's with the mark of urgent messages, over four hops. The
second is the reference: the machine works as hard for the same packets, and none is a broadcast. Every other run has a
load on the mesh: rover1's computer sends to the operator's, over the limited link, too. A run begins with another
scene than the one before, so that none is always first.
"""

from __future__ import annotations

import argparse
import os
import re
import statistics
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.page import append_result, fill, read_results
from benchmarks.practice_fleet import ROOT, PracticeFleet, log, practice_fleet
from meshlab.qemu import control

RESULTS = ROOT / "benchmarks" / "results" / "lan_filter.jsonl"
NODE, ROBOT, ROBOT_DEVICE = "rover2", "rover2", "10.42.0.12"
OPERATOR_ADDRESS, LOADING_ROBOT = "10.42.0.2", "rover1"
LINK_KBPS, BROADCAST_KBPS, LOAD_KBPS = 2000, 500, 400
LIDAR_MBIT_S = 10.0
# of a VLP-16, to its factory destination
PACKET_BYTES, LIDAR_PORT = 1206, 2368
PINGS, PING_EVERY_S = 100, 0.1
BROADCAST = "255.255.255.255"


@dataclass(frozen=True, slots=True)
class Scene:
    lidar_to: str | None
    is_filtered: bool = True


SCENES = {
    "none": Scene(None),
    "unicast on the robot": Scene(ROBOT_DEVICE),
    "broadcast, filtered": Scene(BROADCAST),
    "broadcast, not filtered": Scene(BROADCAST, is_filtered=False),
}

_SENDER = f"""
cat >/run/sender.py <<'END'
import socket, sys, time
address, port, device, bits_per_s = sys.argv[1], int(sys.argv[2]), sys.argv[3], float(sys.argv[4])
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
out.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, device.encode())
start, sent = time.monotonic(), 0
while True:
    while sent < (time.monotonic() - start) * bits_per_s / 8 / {PACKET_BYTES}:
        out.sendto(bytes({PACKET_BYTES}), (address, port))
        sent += 1
    time.sleep(0.005)
END
"""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lan_filter", description=__doc__)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    if not arguments.tables:
        measure(arguments.results, arguments.runs)
    text = table(read_results(arguments.results))
    print(text)
    if arguments.fill:
        fill("lan filter", text)


def measure(results: Path, runs: int) -> None:
    """Append a line for each scene of each run to the results, as soon as it was measured."""
    filtered = {
        "rover2: {role: robot, address: 10.42.0.12}": "rover2: {role: robot, address: 10.42.0.12, lan_filter: {}}"
    }
    with tempfile.TemporaryDirectory() as folder, practice_fleet(Path(folder), filtered) as lab:
        lab.machine(_SENDER)
        lab.settle()
        lab.fleet.link("base", "b01", rate_kbps=LINK_KBPS, broadcast_kbps=BROADCAST_KBPS)
        for run, load_kbps in ((run, load) for run in range(runs) for load in (0, LOAD_KBPS)):
            names = list(SCENES)
            for name in names[run % len(names) :] + names[: run % len(names)]:
                found = _measured(lab, SCENES[name], load_kbps)
                line = {"run": run, "scene": name, "load_kbps": load_kbps, "sent": PINGS, "round_trips_ms": found}
                append_result(results, line | {"load": round(os.getloadavg()[0], 1)})
                log(f"run {run + 1}, lidar {name}, load {load_kbps} kbit/s: {len(found)} of {PINGS} answered")


def _measured(lab: PracticeFleet, scene: Scene, load_kbps: int) -> list[float]:
    lab.on(NODE, "sh /etc/meshctl/lan-filter.sh" if scene.is_filtered else "nft delete table bridge meshctl_lan")
    with ExitStack() as senders:
        if load_kbps:
            senders.enter_context(_sending(lab, LOADING_ROBOT, OPERATOR_ADDRESS, 1e3 * load_kbps))
        if scene.lidar_to is not None:
            senders.enter_context(_sending(lab, ROBOT, scene.lidar_to, 1e6 * LIDAR_MBIT_S))
        return round_trips_ms(lab)


@contextmanager
def _sending(lab: PracticeFleet, robot: str, destination: str, bits_per_s: float) -> Iterator[None]:
    """The robot's computer sends datagrams; nothing has to receive them."""
    program = f"python3 /run/sender.py {destination} {LIDAR_PORT} eth0 {bits_per_s}"
    pid_file = f"/run/sender.{robot}.pid"
    lab.machine(f"ip netns exec pc.{robot} {program} >/dev/null 2>&1 </dev/null & echo $! >{pid_file}")
    try:
        yield
    finally:
        lab.machine(f"kill $(cat {pid_file})")


def round_trips_ms(lab: PracticeFleet) -> list[float]:
    """Of each answered ping, in milliseconds."""
    words = f"ip netns exec pc.{ROBOT} ping -Q 0xb8 -c {PINGS} -i {PING_EVERY_S} -W 5 {OPERATOR_ADDRESS}"
    # no answer at all is a result here
    text = control.run(lab.fleet.directory, words, timeout_s=PINGS * PING_EVERY_S + 60.0).stdout
    return [float(milliseconds) for milliseconds in re.findall(r"time=([\d.]+) ms", text)]


def table(results: list[dict[str, Any]]) -> str:
    """One row for each load and scene that was measured: medians over the runs."""
    lines = [
        "| load, kbit/s | lidar at 10 Mbit/s | runs | answered | p50, ms | p90, ms | p99, ms |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for load_kbps in sorted({result["load_kbps"] for result in results}):
        for scene in SCENES:
            runs = [result for result in results if result["scene"] == scene and result["load_kbps"] == load_kbps]
            if not runs:
                continue
            answered = statistics.median(len(run["round_trips_ms"]) / run["sent"] for run in runs)
            quantiles = " | ".join(
                f"{statistics.median(_percentile(run['round_trips_ms'], share) for run in runs):.1f}"
                for share in (0.5, 0.9, 0.99)
            )
            lines.append(f"| {load_kbps} | {scene} | {len(runs)} | {answered:.0%} | {quantiles} |")
    return "\n".join(lines)


def _percentile(values: list[float], share: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("inf")


if __name__ == "__main__":
    main()
