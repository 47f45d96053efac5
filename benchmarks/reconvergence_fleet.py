"""The fleet of `reconvergence_udp_mesh`: five of the kernel's radios in one machine, with two parallel relays.

    base - near - one   - far        (each hears only its neighbors; base and far have a computer behind them)
               \\ other /

It is configured through the nodes' UCI files; when it has settled, its traffic is captured, and then the active relay
between far and base is silenced.
"""

from __future__ import annotations

import importlib.util
import io
import json
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from meshctl.device.connection import Completed
from meshlab.fleet import QemuFleet
from meshlab.qemu import control
from meshlab.spec import FleetSpec, LanSpec, LinkSpec, Medium, NodeSpec, RadioSpec

PROGRAMS = Path(__file__).with_name("in_machine")
RELAYS = ("one", "other")
NODES = ("base", "near", *RELAYS, "far")
LINKS = (
    LinkSpec("base", "near"),
    LinkSpec("near", "one"),
    LinkSpec("one", "far"),
    # makes one route the better one: between equal ones BATMAN_IV switches at the first missed round
    LinkSpec("near", "other", loss=0.1),
    LinkSpec("other", "far", loss=0.1),
)
TELEMETRY_S = 0.1
OVERHEARD_S = 20.0
# under emulation on a busy host
_START_S = 600.0
# loop avoidance alone holds a new bat0 for half a minute
_SETTLE_S = 150.0
_COMMAND_S = 60.0
# batman-adv gives up a route after about five missed originator intervals
_ROUNDS = 6
# the window of BATMAN_IV's link quality, in intervals (net/batman-adv/main.h: BATADV_TQ_LOCAL_WINDOW_SIZE)
_WINDOW_ROUNDS = 64
# a pause has ended when telemetry has flowed for this long after it
_FLOWED_S = 4.0
# telemetry stops at once with its relay: without a pause for this long, it had just switched to the other route
_NO_PAUSE_S = 8.0
_PAUSE_S = 90.0
_POLL_S = 0.3

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
# only used by the two daemons of this benchmark
_KEY = "be" * 32
_PYTHON = "PYTHONPATH=/opt/reconvergence python3"


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the table."""

    algorithm: str
    interval_ms: int

    def __str__(self) -> str:
        return f"{self.algorithm}:{self.interval_ms}"


class NoPauseError(Exception):
    """The silenced relay was not, or no longer, on the route of the telemetry."""


def spec() -> FleetSpec:
    """Five nodes; a LAN with a computer at each end."""
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


@contextmanager
def bench(directory: Path) -> Iterator[Bench]:
    """The fleet, with telemetry that flows as soon as there is a mesh."""
    fleet = QemuFleet(spec(), directory).up(wait_s=_START_S)
    try:
        made = Bench(fleet)
        made.put_programs()
        made.start_telemetry()
        yield made
    finally:
        fleet.down()


class Bench:
    """The running fleet with daemons on both computers. All waits end at `ends_s` (monotonic)."""

    def __init__(self, fleet: QemuFleet) -> None:
        self._fleet = fleet
        self.ends_s = float("inf")
        self._configured_s = 0.0

    # -- once --

    def put_programs(self) -> None:
        """Copy udp_mesh, its dependencies and the programs of `in_machine` into the machine."""
        python = self._machine("python3 -c 'import sys; print(sys.version_info[:2])'").strip()
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
                tar.add(PROGRAMS / program, program)
        self._feed("mkdir -p /opt/reconvergence && tar -x -C /opt/reconvergence", archive.getvalue())

    def start_telemetry(self) -> None:
        for name in ("base-station", "robot"):
            program = f"ip netns exec pc.{name} env {_PYTHON}"
            self._machine(_DAEMON.format(name=name, program=program, key=_KEY))
        for name, words in (
            ("base-station", "record /run/mesh-base-station/socket /run/arrivals"),
            ("robot", f"send /run/mesh-robot/socket {TELEMETRY_S}"),
        ):
            self._machine(f"n=0; until [ -S /run/mesh-{name}/socket ] || [ $((n += 1)) -gt 200 ]; do sleep 0.2; done")
            client = f"{_PYTHON} /opt/reconvergence/telemetry.py {words}"
            self._machine(f"{client} >/run/mesh-{name}/client.log 2>&1 </dev/null &")

    # -- each case --

    def configure(self, case: Case) -> None:
        """Set algorithm and interval on every node; batman-adv uses an algorithm only when bat0 is recreated."""
        # BATMAN_V measures links with ELP, by default twice per OGM interval
        elp = f"set network.mesh0.elp_interval={case.interval_ms // 2}" if case.algorithm == "BATMAN_V" else ""

        def set_node(number: int) -> None:
            words = _CONFIGURE.format(
                address=f"10.42.0.{101 + number}", algorithm=case.algorithm, interval_ms=case.interval_ms, elp=elp
            )
            self._fleet.node(NODES[number]).exec(words, timeout_s=_COMMAND_S).check(f"configure {NODES[number]}")

        with ThreadPoolExecutor(len(NODES)) as pool:
            list(pool.map(set_node, range(len(NODES))))
        self._configured_s = time.monotonic()
        for name in NODES:
            mesh = json.loads(self._on(name, "batctl meshif bat0 mesh_json"))
            found = (mesh["algo_name"], mesh["orig_interval"])
            if found != (case.algorithm, case.interval_ms):
                raise RuntimeError(f"{name}: expected {case}, found {found}")

    def settle(self, case: Case) -> None:
        """Wait until link qualities have converged, both relays have been heard from both sides for several intervals,
        and telemetry flows."""

        def is_settled() -> bool:
            relays = {_mac(name) for name in RELAYS}
            return (
                all(relays <= self._neighbors(name, case) for name in ("near", "far"))
                and self._next_hop("far", "base") in relays
                and self._next_hop("near", "far") in relays
                and self._flows()
            )

        filled_s = self._configured_s + _WINDOW_ROUNDS * case.interval_ms / 1000
        self._until(lambda: time.monotonic() > filled_s, "qualities to settle", _SETTLE_S)
        self._until(is_settled, "the mesh to settle", _SETTLE_S)
        time.sleep(_ROUNDS * case.interval_ms / 1000)
        self._until(is_settled, "the mesh to stay settled", _SETTLE_S)

    def overheard(self) -> list[dict[str, Any]]:
        """The packets of batman-adv itself in `OVERHEARD_S`."""
        lines = self._machine(f"{_PYTHON} /opt/reconvergence/overhear.py {OVERHEARD_S}", timeout_s=OVERHEARD_S + 60)
        return [
            {"kind": kind, "rate": int(rate), "bytes": int(length), "count": int(count)}
            for kind, rate, length, count in map(str.split, lines.splitlines())
        ]

    def pause_s(self) -> float:
        """Silence the active relay; returns the longest pause between two messages from then on, in seconds.

        Raises NoPauseError when there was none.
        """
        relay = next((name for name in RELAYS if _mac(name) == self._next_hop("far", "base")), "")
        if not relay:
            raise NoPauseError("far has no relay towards base")
        before = self._now_s()
        self._fleet.inject_fault(relay, "sever")
        try:
            self._until(lambda: self._pause_since(before) is not None, "telemetry over the other relay", _PAUSE_S)
            pause_s = self._pause_since(before)
        finally:
            self._fleet.repair(relay)
        if not pause_s:
            raise NoPauseError(f"telemetry did not pause when {relay} was silenced")
        return pause_s

    def check_runs(self) -> None:
        """Raises MeshctlError when the machine has ended."""
        self._fleet.status()

    def _pause_since(self, before_s: float) -> float | None:
        """The longest pause since then once it has ended; 0 when there is none; None while this is undecided."""
        arrivals = self._arrivals(before_s - 5 * TELEMETRY_S)
        return longest_pause(arrivals, before_s, self._now_s())

    def _flows(self) -> bool:
        now_s = self._now_s()
        return len(self._arrivals(now_s - 3.0)) > 2.0 / TELEMETRY_S

    def _arrivals(self, since_s: float) -> list[float]:
        lines = self._machine("tail -n 2000 /run/arrivals 2>/dev/null || true").splitlines()
        return [at_s for line in lines if (at_s := float(line.split()[0])) >= since_s]

    def _now_s(self) -> float:
        return float(self._machine("cut -d' ' -f1 /proc/uptime"))

    def _next_hop(self, node: str, target: str) -> str:
        known = json.loads(self._on(node, "batctl meshif bat0 originators_json") or "[]")
        hops = [
            originator["neigh_address"]
            for originator in known
            if originator.get("best") and originator["orig_address"] == _mac(target)
        ]
        return str(hops[0]) if hops else ""

    def _neighbors(self, name: str, case: Case) -> set[str]:
        known = json.loads(self._on(name, "batctl meshif bat0 neighbors_json") or "[]")
        return {
            neighbor["neigh_address"] for neighbor in known if neighbor["last_seen_msecs"] < 500 + 2 * case.interval_ms
        }

    def _on(self, name: str, command: str) -> str:
        return self._fleet.node(name).exec(command, timeout_s=_COMMAND_S).check(f"{name}: {command}").stdout

    def _machine(self, command: str, *, timeout_s: float = _COMMAND_S) -> str:
        return control.run(self._fleet.directory, command, timeout_s=timeout_s).check(command[:80]).stdout

    def _feed(self, command: str, data: bytes) -> None:
        with tempfile.TemporaryFile() as source, tempfile.TemporaryFile() as said:
            source.write(data)
            source.seek(0)
            descriptors = (source.fileno(), said.fileno(), said.fileno())
            answer = self._fleet.request_with_fds(descriptors, 300.0, "machine", command=command)
            said.seek(0)
            Completed(b"", said.read(), int(answer["status"])).check(command)

    def _until(self, condition: Callable[[], bool], what: str, wait_s: float) -> None:
        begun_s = time.monotonic()
        deadline = min(begun_s + wait_s, self.ends_s)
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {time.monotonic() - begun_s:.0f} s for {what}")
            time.sleep(_POLL_S)


def longest_pause(arrivals_s: list[float], before_s: float, now_s: float) -> float | None:
    """The longest time between two messages, in seconds, once they have flowed again for a while.

    0 when there is no pause since `before_s` and none may be expected any more; None as long as that is open.
    """
    after = [at_s for at_s in arrivals_s if at_s >= before_s]
    pauses = [(later - earlier, later) for earlier, later in pairwise(arrivals_s)]
    if not after or not pauses:
        return None
    longest_s, ended_s = max(pauses)
    # a relay that is silenced between two messages loses at least one
    if longest_s > 3 * TELEMETRY_S:
        return longest_s if after[-1] - ended_s > _FLOWED_S and now_s - after[-1] < 1.0 else None
    return 0.0 if after[-1] - before_s > _NO_PAUSE_S else None
