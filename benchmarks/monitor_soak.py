"""An hour of `meshctl monitor` in accelerated time: `python -m benchmarks.monitor_soak [--radios 200] [--robots 20]
[--hours 1] [--fill]`.

Simulated radios and robots answer with values that change, break down and come back; the real sampler assesses them,
and the real store keeps the frames, with a virtual clock in between. Measured are this process's memory, its CPU time
per frame, the size of the history and how long it takes to read from it.
"""

from __future__ import annotations

import argparse
import gc
import json
import random
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.page import fill, this_machine
from meshctl.device.observation import (
    Bridge,
    ChangeStatus,
    ChannelSurvey,
    Load,
    Memory,
    MeshNeighbor,
    Observation,
    Originator,
    ReleaseInfo,
    Sensors,
    Space,
    Station,
    WirelessLink,
)
from meshctl.inventory import load_fleet
from meshctl.model import Fleet
from meshctl.monitor.sampler import FrameClock, FrameSampler
from meshctl.monitor.store import FrameStore
from meshctl.nodes.collect import reports_of
from meshctl.robots.facts import ComputerFacts, PeerFacts, QueueFacts, RobotFacts, ServiceFacts, TopicFacts
from meshctl.status.assess import Snapshot
from meshctl.status.values import NoAnswer
from meshctl.topology import observed_graph

RESULTS = Path(__file__).with_name("results") / "monitor_soak.jsonl"
INTERVAL_S = 5.0
BEGAN_S = 1_764_000_000.0
_NOISE_DBM = -95
# Of the radios, at any time; each is down for some rounds.
_DOWN_SHARE = 0.02
# Bytes of one observation over SSH, as benchmarks.status_scale's devices answer.
_ANSWER_BYTES = 20_000


def inventory(radios: int, robots: int) -> str:
    """A base, robots with a radio each, and beacons."""
    beacons = radios - robots
    others = "".join(
        f"  robot{n:03d}: {{nodes: [r{n:03d}], computer: {{address: 10.42.200.{n}/16}}}}\n"
        for n in range(2, robots + 1)
    )
    return f"""\
meshctl: 1
fleet: soak
country: US
operators: {{ssh_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGWzgxmFwBtebEfUvHgyG0To5jOoLtmIA3MQHQjEQWFX alice"]}}
hardware:
  box:
    board: ubnt,rocket-m
    profile: ubnt_rocket-m
    target: ath79/generic
    release: "23.05"
    lan_ports: [eth0]
    memory_mib: 64
    radios: {{radio0: {{path: pci0000:00/0000:00:00.0, band: 2g, rated_power_dbm: 27, max_drive_dbm: 27}}}}
meshes:
  main: {{ssid: soak, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, network: 10.42.0.0/16}}
defaults: {{hardware: box, state: deployed, address: {{from: 10.42.1.1}}}}
nodes:
  r[001-{robots:03d}]: {{role: robot}}
  b[001-{beacons:03d}]: {{role: beacon}}
robots:
  base: {{is_base: true, nodes: [r001], computer: {{address: 10.42.200.1/16}}}}
{others}topics:
  estop: {{priority: 0, class: emergency_stop, sources: [base], rate_hz: 0.1}}
  telemetry: {{priority: 3, class: telemetry, rate_hz: 2, deadline_s: 5}}
"""


class SimulatedFleet:
    """Radios on a grid that hear their eight neighbors; `snapshot` is one look at all of them."""

    def __init__(self, fleet: Fleet, rng: random.Random) -> None:
        self.fleet = fleet
        self.rng = rng
        self.now_s = BEGAN_S
        self.names = list(self.fleet.nodes)
        self.width = max(1, round(len(self.names) ** 0.5))
        self.macs = {name: f"02:00:00:00:{n >> 8:02x}:{n & 255:02x}" for n, name in enumerate(self.names)}
        self.by_mac = {mac: name for name, mac in self.macs.items()}
        self.down: dict[str, int] = {}
        self.bytes_by_device: dict[str, int] = {}
        self.rounds = 0

    def near(self, index: int) -> Iterator[str]:
        row, column = divmod(index, self.width)
        for y in (row - 1, row, row + 1):
            for x in (column - 1, column, column + 1):
                at = y * self.width + x
                if 0 <= x < self.width and 0 <= at < len(self.names) and at != index:
                    yield self.names[at]

    def snapshot(self) -> Snapshot:
        self.rounds += 1
        self.down = {name: left - 1 for name, left in self.down.items() if left > 1}
        for name in self.names[1:]:
            if name not in self.down and self.rng.random() < _DOWN_SHARE / 6:
                self.down[name] = self.rng.randint(2, 10)
        seen = {name: self.observation(n, name) for n, name in enumerate(self.names) if name not in self.down}
        for name in seen:
            self.bytes_by_device[name] = self.bytes_by_device.get(name, 0) + _ANSWER_BYTES
        reports = reports_of(seen)
        return Snapshot(
            fleet=self.fleet,
            observations=seen,
            no_answer={name: NoAnswer("does not answer within 5 s") for name in self.down},
            plans={},
            reports=reports,
            graph=observed_graph(reports.values(), known_macs=self.by_mac),
            known={},
            macs=self.by_mac,
            entry=self.names[0],
            robots={name: self.robot(name) for name in self.fleet.robots},
            took_s=1.0,
        )

    def observation(self, index: int, name: str) -> Observation:
        heard = [other for other in self.near(index) if other not in self.down]
        uptime_s = 1000.0 + self.rounds * INTERVAL_S
        active_ms = int(1000 * uptime_s)
        return Observation(
            asked_at_s=self.now_s - 0.5,
            answered_at_s=self.now_s,
            release=ReleaseInfo("OpenWrt", "23.05.5", "r24106", "ath79/generic"),
            boot_id="one",
            uptime_s=uptime_s,
            clock_s=self.now_s - 0.25,
            load=Load(round(self.rng.uniform(0.05, 0.6), 2), 1),
            memory=Memory(64 << 20, 20 << 20, 30 << 20),
            overlay=Space("/overlay", 4 << 20, 2 << 20),
            macs={"mesh0": self.macs[name]},
            links=(WirelessLink("mesh0", "IBSS", self.macs[name], "soak", channel=6, joined=True, phy="phy0"),),
            stations=tuple(self.station(other) for other in heard),
            surveys=(ChannelSurvey("mesh0", 2437, _NOISE_DBM, active_ms, int(active_ms * 0.3)),),
            sensors=Sensors({"phy0": self.rng.randint(0, 120)}, {"phy0": 45.0 + self.rng.random()}),
            bridges=(Bridge("br-lan", ("eth0", "bat0")),),
            neighbors=tuple(MeshNeighbor(self.macs[other], "mesh0", self.rng.randint(20, 900)) for other in heard),
            originators=tuple(
                Originator(self.macs[other], self.macs[other], "mesh0", 100, True, tq=self.rng.randint(180, 255))
                for other in heard
            ),
            mesh_statistics={"bat0": {"tx_bytes": self.rounds * 400, "forward_bytes": self.rounds * 90}},
            uci_changes=(),
            change=ChangeStatus("idle"),
        )

    def station(self, other: str) -> Station:
        signal_dbm = self.rng.randint(-86, -50)
        packets = 10 * self.rounds
        return Station(
            "mesh0",
            self.macs[other],
            signal_dbm=signal_dbm,
            chain_signals_dbm=(signal_dbm - 2, signal_dbm - 4),
            tx_mcs="MCS 12",
            rx_mcs="MCS 13",
            tx_mbit_s=78.0,
            rx_mbit_s=104.0,
            expected_mbit_s=32.0,
            tx_packets=packets,
            tx_retries=packets // 5,
            tx_failed=packets // 500,
        )

    def robot(self, name: str) -> RobotFacts:
        peers = tuple(
            PeerFacts(other, True, self.rng.random(), 0.01 + self.rng.random() / 50, self.rng.random() / 20)
            for other in self.fleet.robots
            if other != name
        )
        return RobotFacts(
            name,
            seen_s=self.now_s,
            service=ServiceFacts("active", "enabled", 0, "success"),
            release="one",
            version="0.1.0",
            daemon_uptime_s=4000.0,
            keys=("aa", "bb"),
            peers=peers,
            queues=tuple(QueueFacts(p, self.rng.randint(0, 9), 4000, self.rng.random()) for p in (0, 3, 7)),
            topics=(TopicFacts("estop", 0, 10, 10, 3.0, 3.0), TopicFacts("telemetry", 3, 10, 10, 0.2, 0.3)),
            computer=ComputerFacts(9000.0, (0.5, 0.5, 0.5), 4, 8 << 20, 4 << 20, 100 << 20, 50 << 20, 0.4),
            status={"version": "0.1.0"},
        )


@dataclass(frozen=True, slots=True)
class SoakResult:
    """`rss_mib` are samples of the resident set over the run, evenly spread; times are medians."""

    radios: int
    robots: int
    frames: int
    rss_mib: tuple[float, ...]
    cpu_ms_per_frame: float
    frame_kib: float
    stored_kib_per_frame: float
    file_mib: float
    alarms: int
    latest_ms: float
    timeline_ms: float
    between_ms: float


def resident_mib() -> float:
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return int(text.partition("VmRSS:")[2].split()[0]) / 1024


@contextmanager
def soaked(folder: Path, radios: int, robots: int) -> Iterator[tuple[SimulatedFleet, FrameSampler, FrameStore]]:
    """A simulated fleet, its sampler and its store in `folder`."""
    path = folder / "fleet.yaml"
    path.write_text(inventory(radios, robots), encoding="utf-8")
    fleet = SimulatedFleet(load_fleet(path), random.Random(1))
    with FrameStore.open(folder / "history.sqlite", 86400.0, 1 << 30) as store:
        sampler = FrameSampler(
            fleet.fleet,
            fleet.snapshot,
            store,
            tuple(fleet.fleet.managed()),
            tuple(fleet.fleet.robots),
            interval_s=INTERVAL_S,
            traffic=lambda: dict(fleet.bytes_by_device),
            clock=FrameClock(lambda: fleet.now_s, lambda: fleet.now_s - BEGAN_S),
        )
        yield fleet, sampler, store


def soak(folder: Path, radios: int, robots: int, rounds: int, samples: int = 12) -> SoakResult:
    """Run `rounds` rounds, and read from the history they leave."""
    with soaked(folder, radios, robots) as (fleet, sampler, store):
        rss = []
        cpu_s = time.process_time()
        for number in range(1, rounds + 1):
            fleet.now_s += INTERVAL_S
            frame = sampler.sample()
            if store.problem:
                raise RuntimeError(store.problem)
            if number % max(1, rounds // samples) == 0:
                gc.collect()
                rss.append(round(resident_mib(), 1))
        cpu_ms = 1000 * (time.process_time() - cpu_s) / rounds
        size = sum(file.stat().st_size for file in folder.glob("history.sqlite*"))
        start_s, end_s = store.span() or (0.0, 0.0)
        return SoakResult(
            radios=radios,
            robots=robots,
            frames=rounds,
            rss_mib=tuple(rss),
            cpu_ms_per_frame=round(cpu_ms, 1),
            frame_kib=round(len(frame.json_text) / 1024, 1),
            stored_kib_per_frame=round(size / rounds / 1024, 1),
            file_mib=round(size / 2**20, 1),
            alarms=len(store.alarms(active_only=False, now_s=end_s)),
            latest_ms=_median_ms(lambda: store.at(end_s)),
            timeline_ms=_median_ms(lambda: store.timeline(start_s, end_s, 600)),
            between_ms=_median_ms(lambda: tuple(store.between(start_s, end_s, 120))),
        )


def _median_ms(call: Callable[[], object], times: int = 5) -> float:
    took = []
    for _ in range(times):
        began = time.perf_counter()
        call()
        took.append(time.perf_counter() - began)
    return round(1000 * sorted(took)[times // 2], 2)


def report(results: list[Mapping[str, object]]) -> str:
    lines = [
        "| radios | robots | frames | CPU per frame, ms | frame, KiB | stored, KiB | memory first/last, MiB"
        " | newest, ms | timeline of 600, ms | 120 of all, ms |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for result in results:
        rss = result["rss_mib"]
        assert isinstance(rss, list | tuple)
        cells = (
            *(result["radios"], result["robots"], result["frames"], result["cpu_ms_per_frame"], result["frame_kib"]),
            *(result["stored_kib_per_frame"], f"{rss[0]} / {rss[-1]}"),
            *(result["latest_ms"], result["timeline_ms"], result["between_ms"]),
        )
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.monitor_soak", description=__doc__)
    parser.add_argument("--radios", default="50,200", help="comma-separated numbers of radios")
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    rounds = round(arguments.hours * 3600 / INTERVAL_S)
    results: list[Mapping[str, object]] = []
    for radios in map(int, arguments.radios.split(",")):
        with tempfile.TemporaryDirectory() as folder:
            found = soak(Path(folder), radios, min(arguments.robots, radios // 2), rounds)
        results.append({name: getattr(found, name) for name in found.__dataclass_fields__})
        print(json.dumps(results[-1]), flush=True)
    RESULTS.write_text("".join(json.dumps(result) + "\n" for result in results))
    machine = this_machine()
    cores = f"{machine['cores']} cores, {machine['machine']}, Python {machine['python']}"
    text = f"{report(results)}\n\n{cores}"
    print(text)
    if arguments.fill:
        fill("monitor", text)


if __name__ == "__main__":
    main()
