"""How long telemetry stops when a relay dies: `python -m benchmarks.reconvergence_udp_mesh [--runs N] [--tables]`.

A fleet of real 802.11 radios in one machine (`meshctl lab up --real`), between whose ends two ways lead:

    base - near - best  - far        (each hears only its neighbours; a computer is behind base and behind far)
               \\ spare /

A udp_mesh daemon on each computer; far's sends telemetry. For each of batman-adv's routing algorithms and intervals:
wait until the mesh has settled, listen to what batman-adv itself sends, then silence the relay that telemetry goes
through, and take the longest pause between two messages that arrive. The relay returns, and it starts again. The spare
relay's links lose a tenth of the broadcasts, so that it is clear which relay is in the way.

Each run is appended to the results at once; `--tables` prints the table of what was measured, `--fill` puts it into
docs/reconvergence.md.
"""

from __future__ import annotations

import argparse
import importlib.util
import io
import json
import os
import statistics
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from benchmarks.page import fill
from meshctl.device.connection import Completed
from meshctl.lab.real import control
from meshctl.lab.real.fleet import RealFleet
from meshctl.lab.spec import FleetSpec, LanSpec, LinkSpec, Medium, NodeSpec, RadioSpec

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "reconvergence_udp_mesh.jsonl"
PAGE = ROOT / "docs" / "reconvergence.md"
ALGORITHMS = ("BATMAN_IV", "BATMAN_V")
INTERVALS_MS = (1000, 500, 250, 100)
NODES = ("base", "near", "best", "spare", "far")
LINKS = (
    LinkSpec("base", "near"),
    LinkSpec("near", "best"),
    LinkSpec("best", "far"),
    LinkSpec("near", "spare", loss=0.1),
    LinkSpec("spare", "far", loss=0.1),
)
TELEMETRY_S = 0.1
OVERHEARD_S = 20.0
# under emulation, on a machine that has other things to do
_START_S = 900.0
_SETTLE_S = 240.0
# so long without a pause means that the relay was not in the way
_NO_PAUSE_S = 40.0

_CONFIGURE = """
uci -q batch <<END
set network.lan.ipaddr={address}
set network.bat0=interface
set network.bat0.proto=batadv
set network.bat0.routing_algo={algorithm}
set network.bat0.orig_interval={interval_ms}
set network.mesh0=interface
set network.mesh0.proto=batadv_hardif
set network.mesh0.master=bat0
set network.mesh0.mtu=1560
{elp}
delete network.@device[0].ports
add_list network.@device[0].ports=eth0
add_list network.@device[0].ports=bat0
set wireless.radio0.disabled=0
set wireless.radio0.channel=6
delete wireless.default_radio0
set wireless.mesh0=wifi-iface
set wireless.mesh0.device=radio0
set wireless.mesh0.network=mesh0
set wireless.mesh0.mode=adhoc
set wireless.mesh0.ifname=mesh0
set wireless.mesh0.ssid=reconvergence
set wireless.mesh0.bssid=02:ca:fe:00:00:01
set wireless.mesh0.encryption=none
set wireless.mesh0.mcast_rate=12000
commit
END
reload_config
"""
_DAEMON = """
mkdir -p /run/mesh-{name}
cat >/run/mesh-{name}/config.toml <<END
name = "{name}"
key_file = "/run/mesh-{name}/key"
[topics]
telemetry = {{ priority = 3, reliable = false, keep_last = 1, destinations = ["base-station"] }}
[daemon]
socket = "/run/mesh-{name}/socket"
state_directory = "/run/mesh-{name}"
END
(umask 077; echo {key} >/run/mesh-{name}/key)
cat >/run/mesh-{name}/run.py <<END
from udp_mesh.cli.main import main
main(["run", "/run/mesh-{name}/config.toml"])
END
{program} /run/mesh-{name}/run.py >/run/mesh-{name}/log 2>&1 </dev/null &
"""
# both daemons share it, nobody else ever does
_KEY = "be" * 32
_PYTHON = "PYTHONPATH=/opt/reconvergence python3"


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the table."""

    algorithm: str
    interval_ms: int


def spec() -> FleetSpec:
    """Five nodes; a LAN with a computer at either end."""
    nodes = tuple(
        NodeSpec(
            name,
            medium=Medium.BASE if name == "base" else Medium.NONE,
            mac=f"02:4d:00:{number:02x}:00:00",
            radios=(RadioSpec(mac=_mac(name)),),
            host_key_types=("ed25519",),
        )
        for number, name in enumerate(NODES)
    )
    lans = (LanSpec("base-station", ("base",), "10.42.0.2/24"), LanSpec("robot", ("far",), "10.42.0.10/24"))
    return FleetSpec("reconvergence", nodes, LINKS, lans=lans)


def _mac(name: str) -> str:
    return f"02:4d:00:{NODES.index(name):02x}:00:10"


class Bench:
    """The running fleet with daemons on both computers."""

    def __init__(self, fleet: RealFleet) -> None:
        self._fleet = fleet

    def machine(self, command: str, *, timeout_s: float = 120.0) -> str:
        return control.run(self._fleet.directory, command, timeout_s=timeout_s).check(command[:80]).stdout

    def configure(self, case: Case) -> None:
        """Give every node this algorithm and interval; batman-adv takes an algorithm only when it is made anew."""
        # BATMAN_V measures links with ELP, by default twice in an interval of its OGMs
        elp = f"set network.mesh0.elp_interval={case.interval_ms // 2}" if case.algorithm == "BATMAN_V" else ""
        for number, name in enumerate(NODES, 1):
            words = _CONFIGURE.format(
                address=f"10.42.0.{100 + number}", algorithm=case.algorithm, interval_ms=case.interval_ms, elp=elp
            )
            self._fleet.node(name).exec(words).check(f"configure {name}")
        for name in NODES:
            told = json.loads(self._on(name, "batctl meshif bat0 mesh_json"))
            found = (told["algo_name"], told["orig_interval"])
            if found != (case.algorithm, case.interval_ms):
                raise RuntimeError(f"{name} runs {found} and not {case}")

    def settle(self) -> None:
        """Wait until both relays are heard from both sides, the best one is in the way, and telemetry flows."""

        def is_settled() -> bool:
            relays = {_mac("best"), _mac("spare")}
            return (
                all(relays <= self._neighbours(name) for name in ("near", "far"))
                and self._next_hop("far", "base") == self._next_hop("near", "far") == _mac("best")
                and self._flows()
            )

        _until(is_settled, "the mesh to settle", _SETTLE_S)

    def start_telemetry(self) -> None:
        for name in ("base-station", "robot"):
            program = f"ip netns exec pc.{name} env {_PYTHON}"
            self.machine(_DAEMON.format(name=name, program=program, key=_KEY))
        for name, words in (
            ("base-station", "record /run/mesh-base-station/socket /run/arrivals"),
            ("robot", f"send /run/mesh-robot/socket {TELEMETRY_S}"),
        ):
            self.machine(f"until [ -S /run/mesh-{name}/socket ]; do sleep 0.2; done")
            client = f"{_PYTHON} /opt/reconvergence/telemetry.py {words}"
            self.machine(f"{client} >/run/mesh-{name}/client.log 2>&1 </dev/null &")

    def overheard(self) -> list[dict[str, Any]]:
        """What batman-adv itself sent in `OVERHEARD_S`."""
        lines = self.machine(f"{_PYTHON} /opt/reconvergence/overhear.py {OVERHEARD_S}", timeout_s=OVERHEARD_S + 100)
        return [
            {"kind": kind, "rate": int(rate), "bytes": int(length), "count": int(count)}
            for kind, rate, length, count in map(str.split, lines.splitlines())
        ]

    def pause_s(self) -> float:
        """Silence the best relay; the longest pause between two messages that arrive from then on, in seconds."""
        before = self._now_s()
        self._fleet.break_("best", "sever")
        try:
            _until(lambda: self._pause_since(before) is not None, "telemetry over the spare relay", _SETTLE_S)
        finally:
            self._fleet.mend("best")
        pause_s = self._pause_since(before)
        assert pause_s is not None
        return pause_s

    def _next_hop(self, node: str, target: str) -> str:
        known = json.loads(self._on(node, "batctl meshif bat0 originators_json") or "[]")
        hops = [one["neigh_address"] for one in known if one.get("best") and one["orig_address"] == _mac(target)]
        return str(hops[0]) if hops else ""

    def _pause_since(self, before_s: float) -> float | None:
        """The longest pause since then, once telemetry has flowed for a while after it; None before."""
        arrivals = self._arrivals(before_s - 2.0)
        after = [at_s for at_s in arrivals if at_s >= before_s]
        pauses = [(later - earlier, later) for earlier, later in pairwise(arrivals)]
        if not after or not pauses:
            return None
        longest, ended_s = max(pauses)
        flowed_s = after[-1] - ended_s
        is_over = longest > 3 * TELEMETRY_S and flowed_s > 5.0 and self._now_s() - after[-1] < 1.0
        return longest if is_over or after[-1] - before_s > _NO_PAUSE_S else None

    def _flows(self) -> bool:
        now_s = self._now_s()
        return len(self._arrivals(now_s - 3.0)) > 2.0 / TELEMETRY_S

    def _arrivals(self, since_s: float) -> list[float]:
        lines = self.machine("tail -n 3000 /run/arrivals 2>/dev/null || true").splitlines()
        return [at_s for line in lines if (at_s := float(line.split()[0])) >= since_s]

    def _now_s(self) -> float:
        return float(self.machine("cut -d' ' -f1 /proc/uptime"))

    def _neighbours(self, name: str) -> set[str]:
        known = json.loads(self._on(name, "batctl meshif bat0 neighbors_json") or "[]")
        return {one["neigh_address"] for one in known if one["last_seen_msecs"] < 3000}

    def _on(self, name: str, command: str) -> str:
        return self._fleet.node(name).exec(command).check(f"{name}: {command}").stdout

    def put_programs(self) -> None:
        """udp_mesh, what it needs of this Python's packages, and the programs of `in_machine`, into the machine."""
        python = self.machine("python3 -c 'import sys; print(sys.version_info[:2])'").strip()
        if python != str(sys.version_info[:2]):
            raise RuntimeError(
                f"the machine's Python is {python}; run this with the same, found {sys.version_info[:2]}"
            )
        archive = io.BytesIO()
        with tarfile.open(fileobj=archive, mode="w") as tar:
            for name in ("udp_mesh", "cryptography", "_cffi_backend"):
                found = importlib.util.find_spec(name)
                assert found is not None
                assert found.origin is not None
                origin = Path(found.origin)
                path = origin.parent if found.submodule_search_locations else origin
                tar.add(path, path.name, filter=lambda item: None if item.name.endswith("__pycache__") else item)
            for program in ("telemetry.py", "overhear.py"):
                tar.add(ROOT / "benchmarks" / "in_machine" / program, program)
        self._feed("mkdir -p /opt/reconvergence && tar -x -C /opt/reconvergence", archive.getvalue())

    def _feed(self, command: str, data: bytes) -> None:
        with tempfile.TemporaryFile() as source, tempfile.TemporaryFile() as said:
            source.write(data)
            source.seek(0)
            descriptors = (source.fileno(), said.fileno(), said.fileno())
            answer = self._fleet.ask_with(descriptors, 300.0, "machine", command=command)
            said.seek(0)
            Completed(b"", said.read(), int(answer["status"])).check(command)


@contextmanager
def bench(directory: Path) -> Iterator[Bench]:
    """The fleet, with telemetry ready to flow as soon as a mesh lets it."""
    fleet = RealFleet(spec(), directory).up(wait_s=_START_S)
    try:
        made = Bench(fleet)
        made.put_programs()
        made.start_telemetry()
        yield made
    finally:
        fleet.down()


def _until(condition: Callable[[], bool], what: str, wait_s: float) -> None:
    deadline = time.monotonic() + wait_s
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {wait_s:g} s for {what}")
        time.sleep(0.5)


# -- airtime --


def airtime_us(rate: int, length: int, kind: str) -> float:
    """How long one transmission takes the air, in microseconds: DIFS, the mean back-off, the frame, a probe's ack.

    IEEE 802.11-2020 clauses 15 (DSSS), 17 (OFDM) and 19 (HT, where the rate is not told: MCS 7, 65 Mbit/s); slots of
    9 us, a first contention window of 15 slots.
    """
    spacing_us = 28 + 7.5 * 9
    bits = 8 * (length + 4)
    mbit_s = rate / 2
    if mbit_s in (1, 2, 5.5, 11):
        frame_us = 192 + bits / mbit_s
    elif mbit_s:
        frame_us = 20 + 4 * -(-(22 + bits) // int(4 * mbit_s)) + 6
    else:
        frame_us = 36 + 4 * -(-(22 + bits) // 260) + 6
    # broadcasts get no acknowledgement; a probe's goes at 6 Mbit/s
    acknowledged_us = 10 + 44 if kind == "probe" else 0
    return spacing_us + frame_us + acknowledged_us


def share_of_air(overheard: list[dict[str, Any]]) -> float:
    """What batman-adv itself takes of a channel that all nodes share, 0..1."""
    total_us: float = sum(one["count"] * airtime_us(one["rate"], one["bytes"], one["kind"]) for one in overheard)
    return total_us / (OVERHEARD_S * 1e6)


# -- results --


def finished(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def table(results: list[dict[str, Any]]) -> str:
    """One row per case: pauses, and what batman-adv costs."""
    lines = [
        "| algorithm | interval | telemetry pauses for (median, all runs) | packets/s of its own | of the air |",
        "| --- | --- | --- | --- | --- |",
    ]
    for algorithm in ALGORITHMS:
        for interval_ms in INTERVALS_MS:
            of_case = [one for one in results if (one["algorithm"], one["interval_ms"]) == (algorithm, interval_ms)]
            if not of_case:
                continue
            pauses = sorted(one["pause_s"] for one in of_case)
            each = ", ".join(f"{pause_s:.1f}" for pause_s in pauses)
            rate = statistics.median(sum(item["count"] for item in one["overheard"]) / OVERHEARD_S for one in of_case)
            share = statistics.median(share_of_air(one["overheard"]) for one in of_case)
            lines.append(
                f"| {algorithm} | {interval_ms} ms | {statistics.median(pauses):.1f} s ({each}) "
                f"| {rate:.0f} | {share:.2%} |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reconvergence_udp_mesh", description=__doc__)
    parser.add_argument("--case", action="append", default=[], help="only this one, such as BATMAN_IV:250 (repeatable)")
    parser.add_argument("--runs", type=int, default=3, help="how often the relay dies in each case")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of what was measured")
    parser.add_argument("--fill", action="store_true", help="put the table into docs/reconvergence.md")
    arguments = parser.parse_args()
    if not arguments.tables:
        measure(arguments.results, arguments.runs, arguments.case)
    text = table(finished(arguments.results))
    print(text)
    if arguments.fill:
        fill("reconvergence", text, PAGE)


def measure(path: Path, runs: int, only: list[str]) -> None:
    done = [Case(one["algorithm"], one["interval_ms"]) for one in finished(path)]
    wanted = [Case(algorithm, interval_ms) for algorithm in ALGORITHMS for interval_ms in INTERVALS_MS]
    todo = [
        case
        for case in wanted
        if done.count(case) < runs and (not only or f"{case.algorithm}:{case.interval_ms}" in only)
    ]
    if not todo:
        return
    with tempfile.TemporaryDirectory() as folder, bench(Path(folder)) as made:
        for case in todo:
            made.configure(case)
            made.settle()
            overheard = made.overheard()
            for run in range(done.count(case), runs):
                made.settle()
                pause_s = made.pause_s()
                result = {
                    "algorithm": case.algorithm,
                    "interval_ms": case.interval_ms,
                    "pause_s": round(pause_s, 2),
                    "overheard": overheard,
                    "load": round(os.getloadavg()[0], 1),
                }
                with path.open("a") as file:
                    file.write(json.dumps(result) + "\n")
                print(f"{case} run {run + 1}: {pause_s:.2f} s", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
