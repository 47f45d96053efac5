"""Urgent messages beside a lidar that broadcasts on the robot's LAN: `python -m benchmarks.lan_filter [--fill]`.

The lab's example fleet is provisioned on the kernel's 802.11 radios with a LAN filter on rover2's radio, and the base's
link is limited to a tenth of what the lidar sends, as a channel at the multicast rate would be. Then, in each run:

    lidar to a device on the robot, filter on -> lidar to 255.255.255.255, filter on -> the same, filter off

and in each of the three, rover2's computer pings the operator's with the mark of urgent messages, over four hops. The
first is the reference: the machine works as hard for the same packets, and none is a broadcast.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.page import fill
from benchmarks.practice_fleet import ROOT, PracticeFleet, log, practice_fleet
from meshlab.qemu import control

RESULTS = ROOT / "benchmarks" / "results" / "lan_filter.jsonl"
NODE, ROBOT, ROBOT_DEVICE = "rover2", "rover2", "10.42.0.12"
LINK_KBPS = 1000
LIDAR_MBIT_S = 10.0
# of a VLP-16, to its factory destination
PACKET_BYTES = 1206
PINGS, PING_EVERY_S = 100, 0.1
SCENES = {"unicast on the robot": True, "broadcast, filtered": True, "broadcast, not filtered": False}

_LIDAR = f"""
cat >/run/lidar.py <<'END'
import socket, sys, time
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
out.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"eth0")
start, sent = time.monotonic(), 0
while True:
    while sent < (time.monotonic() - start) * {LIDAR_MBIT_S * 1e6 / 8 / PACKET_BYTES}:
        out.sendto(bytes({PACKET_BYTES}), (sys.argv[1], 2368))
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
    text = table([json.loads(line) for line in arguments.results.read_text(encoding="utf-8").splitlines()])
    print(text)
    if arguments.fill:
        fill("lan filter", text)


def measure(results: Path, runs: int) -> None:
    """Append a line for each scene of each run to the results, as soon as it was measured."""
    filtered = {
        "rover2: {role: robot, address: 10.42.0.12}": "rover2: {role: robot, address: 10.42.0.12, lan_filter: {}}"
    }
    with tempfile.TemporaryDirectory() as folder, practice_fleet(Path(folder), filtered) as lab:
        lab.machine(_LIDAR)
        lab.settle()
        lab.fleet.link("base", "b01", rate_kbps=LINK_KBPS)
        for run in range(runs):
            for scene, is_filtered in SCENES.items():
                words = "sh /etc/meshctl/lan-filter.sh" if is_filtered else "nft delete table bridge meshctl_lan"
                lab.on(NODE, words)
                found = round_trips_ms(lab, "255.255.255.255" if "broadcast" in scene else ROBOT_DEVICE)
                line: dict[str, Any] = {"run": run, "scene": scene, "sent": PINGS, "round_trips_ms": found}
                with results.open("a", encoding="utf-8") as file:
                    file.write(f"{json.dumps(line | {'load': round(os.getloadavg()[0], 1)})}\n")
                log(f"run {run + 1}, {scene}: {len(found)} of {PINGS} answered")


def round_trips_ms(lab: PracticeFleet, destination: str) -> list[float]:
    """Of each answered ping, in milliseconds, while the lidar sends to `destination`."""
    program = f"python3 /run/lidar.py {destination} >/dev/null 2>&1 </dev/null"
    lab.machine(f"ip netns exec pc.{ROBOT} {program} & echo $! >/run/lidar.pid")
    try:
        words = f"ip netns exec pc.{ROBOT} ping -Q 0xb8 -c {PINGS} -i {PING_EVERY_S} -W 5 10.42.0.2"
        # no answer at all is a result here
        text = control.run(lab.fleet.directory, words, timeout_s=PINGS * PING_EVERY_S + 60.0).stdout
    finally:
        lab.machine("kill $(cat /run/lidar.pid)")
    return [float(one) for one in re.findall(r"time=([\d.]+) ms", text)]


def table(results: list[dict[str, Any]]) -> str:
    """One row for each scene: medians over the runs."""
    lines = ["| lidar at 10 Mbit/s | runs | answered | p50, ms | p99, ms |", "| --- | --- | --- | --- | --- |"]
    for scene in SCENES:
        runs = [one for one in results if one["scene"] == scene]
        answered = statistics.median(len(one["round_trips_ms"]) / one["sent"] for one in runs)
        p50, p99 = (
            statistics.median(_percentile(one["round_trips_ms"], share) for one in runs) for share in (0.5, 0.99)
        )
        lines.append(f"| {scene} | {len(runs)} | {answered:.0%} | {p50:.1f} | {p99:.1f} |")
    return "\n".join(lines)


def _percentile(values: list[float], share: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("inf")


if __name__ == "__main__":
    main()
