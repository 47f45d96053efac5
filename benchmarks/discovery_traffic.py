"""Discovery on the wire: `python -m benchmarks.discovery_traffic [--kinds fast-dds,...] [--sizes 10,50] [--fill]`.

Each member of a team is a process in a network namespace of its own, all on one bridge without loss: ROS 2 nodes with
Fast DDS, Cyclone DDS participants, or nodes of udp_mesh. They start at one moment, or one after the other over some
seconds (`--spread`), which leaves the machine time for each. Counted is what the members send, each multicast or
broadcast once, as on a radio channel: during the start, and then for a minute without publications.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.link.laboratory import INTERFACE, LaboratoryError
from benchmarks.page import append_result, fill, this_machine
from benchmarks.peers import ROS2_PYTHON

RESULTS = Path(__file__).with_name("results") / "discovery_traffic.jsonl"
KINDS = {
    "fast-dds": "ROS 2 Fast DDS, node",
    "fast-dds-lean": "ROS 2 Fast DDS, node without parameter services and rosout",
    "cyclone-dds": "Cyclone DDS, participant",
    "udp-mesh": "udp_mesh, node",
}
# fifty imports of a library
READY_TIMEOUT_S = 300.0
# the start is over this long after all know all, and not before the first time
SETTLE_S = 5.0
MIN_START_S = 15.0
MAX_START_S = 120.0
REST_S = 60.0
_BRIDGE = "team0"


@dataclass(frozen=True, slots=True)
class Sent:
    """What all members sent so far, Ethernet headers included."""

    frames: int
    bytes: int

    def since(self, before: Sent) -> Sent:
        return Sent(self.frames - before.frames, self.bytes - before.bytes)


class Team:
    """Namespaces `PREFIX-0`, `PREFIX-1`, ... on a bridge in the namespace `PREFIX`."""

    def __init__(self, size: int) -> None:
        self._hub = f"team{os.getpid()}"
        self.namespaces = [f"{self._hub}-{index}" for index in range(size)]
        self._made: list[str] = []

    def make(self) -> None:
        self._add(self._hub)
        _ip(self._hub, f"link add {_BRIDGE} type bridge mcast_snooping 0", f"link set {_BRIDGE} up")
        for index, namespace in enumerate(self.namespaces):
            self._add(namespace)
            _ip(
                self._hub,
                f"link add port{index} type veth peer name {INTERFACE} netns {namespace}",
                f"link set port{index} master {_BRIDGE} up",
            )
            _ip(
                namespace, "link set lo up", f"addr add {_address(index)}/16 brd 10.99.255.255 dev {INTERFACE}",
                f"link set {INTERFACE} address {_hardware(index)} up",
            )  # fmt: skip
            # ARP is not discovery
            others = [other for other in range(len(self.namespaces)) if other != index]
            _ip(
                namespace,
                *(
                    f"neigh replace {_address(other)} lladdr {_hardware(other)} dev {INTERFACE} nud permanent"
                    for other in others
                ),
            )

    def sent(self) -> Sent:
        shown = json.loads(_run("ip", "-n", self._hub, "-j", "-s", "link", "show"))
        ports = [link["stats64"]["rx"] for link in shown if link["ifname"].startswith("port")]
        return Sent(sum(port["packets"] for port in ports), sum(port["bytes"] for port in ports))

    def remove(self) -> None:
        for namespace in self._made:
            _run("ip", "netns", "del", namespace)

    def _add(self, namespace: str) -> None:
        _run("ip", "netns", "add", namespace)
        self._made.append(namespace)
        _run("ip", "netns", "exec", namespace, "sysctl", "-qw", "net.ipv6.conf.all.disable_ipv6=1")


def _address(index: int) -> str:
    return f"10.99.{index // 200}.{index % 200 + 1}"


def _hardware(index: int) -> str:
    return f"02:00:00:00:{index // 256:02x}:{index % 256:02x}"


def _run(*command: str, text: str = "") -> str:
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if done.returncode:
        raise LaboratoryError(f"{' '.join(command)}: {done.stderr.strip()}")
    return done.stdout


def _ip(namespace: str, *commands: str) -> None:
    _run("ip", "-n", namespace, "-batch", "-", text="\n".join(commands))


@contextmanager
def team(size: int) -> Iterator[Team]:
    """A team's network; everything is removed afterwards, also after a failure."""
    made = Team(size)
    try:
        made.make()
        yield made
    finally:
        made.remove()


@contextmanager
def members(kind: str, namespaces: Sequence[str]) -> Iterator[list[subprocess.Popen[bytes]]]:
    """The members' processes, ready to start."""
    python = sys.executable if kind == "udp-mesh" else str(ROS2_PYTHON)
    environ = {**os.environ, "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    pipe = subprocess.PIPE
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for index, namespace in enumerate(namespaces):
            command = [python, "-m", "benchmarks.peers.member", kind, f"robot{index}", str(len(namespaces) - 1)]
            inside = ["ip", "netns", "exec", namespace, *command]
            processes.append(subprocess.Popen(inside, stdin=pipe, stdout=pipe, env=environ, bufsize=0))
        until_s = time.monotonic() + READY_TIMEOUT_S
        if not all(_line(process, until_s) == "ready" for process in processes):
            raise RuntimeError(f"{kind}: not all members were ready")
        yield processes
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    stream.close()


def _line(process: subprocess.Popen[bytes], until_s: float) -> str | None:
    """The next line, or None if there is none by then. Raises RuntimeError if the process has ended."""
    assert process.stdout is not None
    readable, _, _ = select.select([process.stdout], [], [], max(0.0, until_s - time.monotonic()))
    if not readable:
        return None
    line = process.stdout.readline().decode().strip()
    if not line:
        raise RuntimeError(f"{process.args!r} ended")
    return line


def measure(
    kind: str,
    size: int,
    spread_s: float = 0.0,
    min_start_s: float = MIN_START_S,
    settle_s: float = SETTLE_S,
    rest_s: float = REST_S,
) -> dict[str, Any]:
    """Start a team and count. `known_s` is from the last start, and None if not all knew all others in time."""
    with team(size) as network, members(kind, network.namespaces) as processes:
        before, began_s = network.sent(), time.monotonic()
        for process in processes:
            time.sleep(spread_s / size)
            assert process.stdin is not None
            process.stdin.write(b"go\n")
        last_s = time.monotonic()
        times = [_line(process, last_s + MAX_START_S) for process in processes]
        known_s = None if None in times else max(float(at) for at in times if at is not None) - last_s
        ends_s = last_s + max(min_start_s, (known_s or MAX_START_S) + settle_s)
        time.sleep(max(0.0, ends_s - time.monotonic()))
        rested = network.sent()
        start_s = time.monotonic() - began_s
        time.sleep(rest_s)
        start, rest = rested.since(before), network.sent().since(rested)
    per_minute = 60.0 / rest_s
    return {
        "kind": kind, "size": size, "spread_s": spread_s, "known_s": known_s, "start_s": start_s,
        "start_frames": start.frames, "start_bytes": start.bytes, "frames_per_minute": rest.frames * per_minute,
        "bytes_per_minute": rest.bytes * per_minute, **this_machine(),
    }  # fmt: skip


def table(results: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        "| members | | started within, s | all know all after, s | start: frames | start: kB "
        "| at rest: frames a minute | at rest: kB a minute | at rest: bytes per member and s |",
        "| --- " * 9 + "|",
    ]
    for result in sorted(
        results, key=lambda result: (result["size"], result["spread_s"], list(KINDS).index(result["kind"]))
    ):
        known = f"not in {MAX_START_S:.0f}" if result["known_s"] is None else f"{result['known_s']:.1f}"
        lines.append(
            f"| {result['size']} | {KINDS[result['kind']]} | {result['spread_s']:.0f} | {known} "
            f"| {result['start_frames']:,} "
            f"| {result['start_bytes'] / 1e3:,.0f} | {result['frames_per_minute']:,.0f} "
            f"| {result['bytes_per_minute'] / 1e3:,.0f} | {result['bytes_per_minute'] / 60 / result['size']:,.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.discovery_traffic", description=__doc__)
    parser.add_argument("--kinds", default=",".join(KINDS), help=f"comma-separated, of {', '.join(KINDS)}")
    parser.add_argument("--sizes", default="10,50", help="numbers of members")
    parser.add_argument("--spread", type=float, default=0.0, help="start the members evenly over this time in seconds")
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help="file of results; what it already has is not run again"
    )
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    results = [json.loads(line) for line in arguments.results.open()] if arguments.results.exists() else []
    for size in map(int, arguments.sizes.split(",")):
        for kind in arguments.kinds.split(","):
            if any(
                (result["kind"], result["size"], result["spread_s"]) == (kind, size, arguments.spread)
                for result in results
            ):
                continue
            print(f"{size} members: {KINDS[kind]}", file=sys.stderr, flush=True)
            results.append(measure(kind, size, arguments.spread))
            append_result(arguments.results, results[-1])
    print(table(results))
    if arguments.fill:
        fill("discovery-traffic", table(results))


if __name__ == "__main__":
    main()
