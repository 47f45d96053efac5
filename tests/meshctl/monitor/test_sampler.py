"""The sampler takes frames on a schedule, whatever fails, and stays within its share of the channel."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from meshctl.errors import MeshctlError
from meshctl.inventory import load_fleet
from meshctl.model import Fleet
from meshctl.monitor.airtime import MAC_EFFICIENCY, OVERHEAD, airtime_use, next_interval_s
from meshctl.monitor.alarm_log import LoggedAlarm
from meshctl.monitor.frame import Frame, FramePosition
from meshctl.monitor.sampler import FrameClock, FrameSampler, fixed_positions, reported_positions
from meshctl.monitor.store import MIN_BYTES, FrameStore
from meshctl.status.assess import Snapshot
from tests.meshctl.status.fleets import INVENTORY, NOW, look_of, trio

HOPS = {"nodes": [{"name": "b01", "hops": 2, "via": "b00", "neighbours": []}]}


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return trio(tmp_path)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[FrameStore]:
    with FrameStore.open(tmp_path / "history.sqlite", 86400.0, MIN_BYTES) as opened:
        yield opened


@dataclass
class Time:
    """A wall and a monotonic clock."""

    wall_s: float = NOW
    tick_s: float = 100.0

    def forward(self, seconds: float) -> None:
        self.wall_s += seconds
        self.tick_s += seconds


@dataclass
class Rig:
    """A sampler of the trio whose snapshots cost `bytes_per_round` to each node."""

    fleet: Fleet
    store: FrameStore
    time: Time = field(default_factory=Time)
    bytes_per_round: int = 10_000
    sent: dict[str, int] = field(default_factory=dict)
    failure: Exception | None = None
    seen: list[tuple[Frame, Sequence[LoggedAlarm]]] = field(default_factory=list)

    def collect(self) -> Snapshot:
        if self.failure is not None:
            raise self.failure
        self.time.forward(0.5)
        for name in ("base", "b01", "rover", "robot.rover"):
            self.sent[name] = self.sent.get(name, 0) + self.bytes_per_round
        return look_of(self.fleet)

    def sampler(self, **other: object) -> FrameSampler:
        made = FrameSampler(
            self.fleet,
            self.collect,
            self.store,
            tuple(self.fleet.managed()),
            tuple(self.fleet.robots),
            traffic=lambda: dict(self.sent),
            clock=FrameClock(lambda: self.time.wall_s, lambda: self.time.tick_s),
        )
        made.listeners.append(lambda frame, began: self.seen.append((frame, began)))
        return replace(made, **other)  # type: ignore[arg-type]


def test_a_round_becomes_a_frame_with_verdict_links_radios_and_cost(fleet: Fleet, store: FrameStore) -> None:
    rig = Rig(fleet, store)
    frame = rig.sampler(positions=lambda: {"b01": FramePosition(1.0, 2.0, None, 0.5, "daemon")}).sample()
    document = frame.document
    assert store.latest() == frame
    assert (document["time_s"], document["fleet"], document["schema"]) == (NOW + 0.5, "trio", 1)
    assert document["verdict"] == {
        "go": False,
        "text": "NO-GO",
        "reasons": ["beacons: b02: never seen; power it on once before packing"],
    }
    links = {(link["from"], link["to"]): link for link in document["links"]}
    assert set(links) == {("b01", "base"), ("base", "b01"), ("rover", "b01"), ("b01", "rover")}
    assert links["b01", "rover"]["mcs"] == "MCS 12", "what the receiver reports of frames from there"
    assert (links["b01", "rover"]["snr_db"], links["b01", "rover"]["noise_dbm"]) == (35, -95)
    assert document["radios"]["b01"][0]["busy_ratio"] == 0.3
    assert document["positions"] == {"b01": {"x_m": 1.0, "y_m": 2.0, "z_m": None, "age_s": 0.5, "source": "daemon"}}
    assert document["airtime"]["bytes_per_s"] == 4 * 10_000 / document["airtime"]["interval_s"]
    assert rig.seen[0][0] == frame
    assert {one.key for one in rig.seen[0][1]} == {one.key for one in store.alarms(now_s=NOW)}


def test_the_airtime_counts_every_hop_at_the_rate_of_the_first() -> None:
    use = airtime_use({"b01": 1000, "unknown": 500}, HOPS)
    assert use.bytes == 1500
    assert use.airtime_s == pytest.approx(1000 * OVERHEAD * 8 * 2 / 3e6)
    faster = {"nodes": [{**HOPS["nodes"][0], "neighbours": [{"name": "b00", "tx_bitrate_kbit_s": 60_000}]}]}
    assert airtime_use({"b01": 1000}, faster).airtime_s == pytest.approx(1000 * OVERHEAD * 16 / (60e6 * MAC_EFFICIENCY))
    neighbor = {"name": "b00", "tx_bitrate_kbit_s": 60_000, "expected_kbit_s": 12_000}
    measured = {"nodes": [{**HOPS["nodes"][0], "neighbours": [neighbor]}]}
    assert airtime_use({"b01": 1000}, measured).airtime_s == pytest.approx(1000 * OVERHEAD * 16 / 12e6)
    assert airtime_use({"b01": 1000}, {"nodes": []}).airtime_s is None
    robot = {**HOPS, "robots": [{"name": "spot", "radios": ["b01"]}]}
    assert airtime_use({"robot.spot": 1000}, robot) == airtime_use({"b01": 1000}, HOPS)


@pytest.mark.parametrize(
    ("airtime_s", "expected_s"), [(None, 5.0), (0.1, 5.0), (0.15, 5.0), (0.3, 10.0), (1000.0, 300.0)]
)
def test_the_interval_is_stretched_over_the_limit(airtime_s: float | None, expected_s: float) -> None:
    assert next_interval_s(5.0, airtime_s, 0.03, 300.0) == pytest.approx(expected_s)
    assert next_interval_s(600.0, airtime_s, 0.03, 300.0) == 600.0, "never shorter than asked for"


def test_an_expensive_fleet_is_looked_at_less_often_and_stays_within_the_limit(fleet: Fleet, store: FrameStore) -> None:
    rig = Rig(fleet, store, bytes_per_round=200_000)
    sampler = rig.sampler(interval_s=1.0, limit_share=0.03)
    for _ in range(4):
        began_s = rig.time.tick_s
        airtime = sampler.sample().document["airtime"]
        assert airtime["interval_s"] > 1.0
        assert airtime["share"] <= 0.03 + 1e-6
        rig.time.forward(began_s + airtime["interval_s"] - rig.time.tick_s)
    rig.bytes_per_round = 10
    assert sampler.sample().document["airtime"]["interval_s"] == 1.0


@pytest.mark.parametrize(
    ("failure", "problem"),
    [
        (MeshctlError("the journal is locked"), "the journal is locked"),
        (KeyError("nodes"), "internal error: KeyError: 'nodes'"),
        (RecursionError("too deep"), "internal error: RecursionError: too deep"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_failed_round_is_a_problem_and_the_next_one_is_tried(
    fleet: Fleet, store: FrameStore, failure: Exception, problem: str
) -> None:
    rig = Rig(fleet, store, failure=failure)
    sampler = rig.sampler(interval_s=0.001)
    failed, frames = threading.Event(), threading.Event()
    sampler.listeners.append(lambda frame, began: frames.set())
    # time stands still for the wait, so that rounds follow each other
    thread = threading.Thread(target=sampler.run)
    thread.start()
    while not sampler.problem:
        failed.wait(0.001)
    assert sampler.problem == problem
    rig.failure = None
    assert frames.wait(10)
    sampler.stop()
    thread.join(10)
    assert not thread.is_alive()
    assert sampler.problem == ""


def test_frames_stay_in_order_while_the_clock_is_set_back(fleet: Fleet, store: FrameStore) -> None:
    rig = Rig(fleet, store)
    sampler = rig.sampler()
    first = sampler.sample().time_s
    rig.time.wall_s -= 3600
    rig.time.forward(5)
    assert sampler.sample().time_s == first + 5.5, "it continues at the pace of the monotonic clock"
    rig.time.wall_s += 7200
    assert sampler.sample().time_s == first + 3600 + 6, "a clock that is set forward is followed"
    assert store.clock_stepped_s == pytest.approx(3600.0)
    # another process whose clock is wrong
    behind = Rig(fleet, store, Time(wall_s=NOW - 500))
    assert behind.sampler().sample().time_s == first + 3606.001


def test_a_clock_that_is_set_forward_expires_nothing(fleet: Fleet, tmp_path: Path) -> None:
    with FrameStore.open(tmp_path / "short.sqlite", 60.0, MIN_BYTES) as store:
        rig = Rig(fleet, store)
        sampler = rig.sampler()
        first = sampler.sample().time_s
        rig.time.wall_s += 40 * 365 * 86400.0
        sampler.sample()
        assert store.span() is not None
        assert (store.span() or (0.0,))[0] == first
        # it is old after its time all the same
        rig.time.forward(60)
        newest = sampler.sample().time_s
        assert (store.span() or (0.0,))[0] == pytest.approx(newest - 60.5)


def test_what_daemons_report_goes_before_the_inventory(fleet: Fleet) -> None:
    status = {"robots": [{"name": "rover", "radios": ["rover"], "position": {"x_m": 4.0, "y_m": 5.0, "age_s": 2.0}}]}
    assert reported_positions(status) == {"rover": FramePosition(4.0, 5.0, None, 2.0, "daemon")}
    assert reported_positions({"robots": [{"name": "rover", "radios": [], "position": None}, {"name": "spot"}]}) == {}


def test_positions_of_robots_and_radios_go_together(tmp_path: Path) -> None:
    path = tmp_path / "placed.yaml"
    text = INVENTORY.replace("is_base: true,", "is_base: true, position: {x_m: 1, y_m: 2},")
    path.write_text(text.replace("address: 10.42.0.2}", "address: 10.42.0.2, position: {x_m: 9, y_m: 0, z_m: 3}}"))
    here = FramePosition(1.0, 2.0, None, None, "inventory")
    assert fixed_positions(load_fleet(path)) == {"station": here, "base": here, "b01": FramePosition(9.0, 0.0, 3.0)}
