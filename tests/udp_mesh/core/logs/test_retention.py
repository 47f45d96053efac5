"""Logs are bounded; what is dropped is reported, and never what a program waits for."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.udp_mesh.core.logs.team import LogTeam
from udp_mesh.core.events import ExpiryReason, LogItemDropped, Rejected, RejectReason
from udp_mesh.core.logs.item import ItemId
from udp_mesh.core.logs.store import ItemUse, MemoryLogStore
from udp_mesh.core.settings import Log, Outbox, Topic


def bounded(**limits: object) -> Topic:
    return Topic("artifact", priority=4, log=Log(readers=("base",), **limits))  # type: ignore[arg-type]


def dropped(team: LogTeam, name: str) -> list[LogItemDropped]:
    return [event for event in team.events_of(name, LogItemDropped) if isinstance(event, LogItemDropped)]


def test_a_full_log_drops_its_oldest_own_items_and_says_so() -> None:
    team = LogTeam("base", "spot", topics=[bounded(max_items=3)])
    for number in range(5):
        team.publish("spot", b"%d" % number)
        team.run(1)
    assert [(event.number, event.reason) for event in dropped(team, "spot")] == [
        (1, ExpiryReason.LOG_FULL),
        (2, ExpiryReason.LOG_FULL),
    ]
    team.meet("spot", "base", seconds=5)
    assert [number for _, number, _ in team.read("base")] == [3, 4, 5]


def test_what_all_readers_have_is_dropped_first_and_without_a_word() -> None:
    team = LogTeam("base", "spot", topics=[bounded(max_items=3)])
    for number in range(3):
        team.publish("spot", b"%d" % number)
    team.meet("spot", "base", seconds=5)
    for number in range(3, 6):
        team.publish("spot", b"%d" % number)
    team.meet("spot", "base", seconds=5)
    assert dropped(team, "spot") == []
    assert [number for _, number, _ in team.read("base")] == [1, 2, 3, 4, 5, 6]


def test_a_full_carrier_takes_no_more() -> None:
    team = LogTeam("base", "husky", "spot", topics=[bounded(max_items=4)])
    team.stop("husky")
    team.topics = (bounded(max_items=2),)
    team.start("husky")
    team.separate()
    for number in range(4):
        team.publish("spot", b"%d" % number)
    team.meet("spot", "husky", seconds=8)
    assert sorted(item.number for item in team.stores["husky"].items) == [1, 2]
    assert dropped(team, "husky") == []
    team.meet("husky", "base", seconds=5)
    team.meet("spot", "husky", seconds=8)
    team.meet("husky", "base", seconds=5)
    assert [number for _, number, _ in team.read("base")] == [1, 2, 3, 4]


def test_a_carrier_drops_others_items_before_its_own() -> None:
    team = LogTeam("base", "husky", "spot", topics=[bounded(max_items=2)])
    team.publish("spot", b"spot's")
    team.meet("spot", "husky", seconds=5)
    team.publish("husky", b"one")
    team.publish("husky", b"two")
    team.run(1)
    assert [(event.source, event.number) for event in dropped(team, "husky")] == [("spot", 1)]


def test_items_that_no_program_took_stop_further_requests() -> None:
    team = LogTeam("base", "spot", topics=[bounded(max_items=3)])
    team.stop("base")
    team.topics = (bounded(max_items=2),)
    team.start("base", confirms=True)
    team.separate()
    for number in range(3):
        team.publish("spot", b"%d" % number)
    team.meet("spot", "base", seconds=8)
    assert [number for _, number, _ in team.read("base")] == [1, 2]
    assert dropped(team, "base") == []


def test_items_older_than_the_log_keeps_are_dropped_everywhere() -> None:
    team = LogTeam("base", "husky", "spot", topics=[bounded(max_age_s=60.0)])
    team.publish("spot", b"old")
    team.meet("spot", "husky", seconds=5)
    team.run(70)
    assert team.stores["spot"].items == team.stores["husky"].items == {}
    assert [event.reason for event in dropped(team, "spot")] == [ExpiryReason.TOO_OLD]
    team.meet("husky", "base", seconds=5)
    assert team.read("base") == []


def test_numbers_of_dropped_items_are_never_used_again() -> None:
    team = LogTeam("base", "spot", topics=[bounded(max_age_s=30.0)])
    team.publish("spot", b"old")
    team.run(40)
    team.stop("spot")
    team.start("spot")
    team.separate()
    team.publish("spot", b"new")
    team.meet("spot", "base", seconds=5)
    assert team.read("base") == [("spot", 2, b"new")]


def test_an_item_that_cannot_fit_is_refused() -> None:
    team = LogTeam("base", "spot", topics=[bounded(max_bytes=1000)])
    result = team.send("spot", "artifact", bytes(2000))
    assert isinstance(result, Rejected)
    assert result.reason is RejectReason.LOG_FULL
    assert "does not fit" in result.detail


class FullDisk(MemoryLogStore):
    """Refuses to write while `full`."""

    full = True

    def put(self, item: ItemId, data: bytes, use: ItemUse, done: Callable[[bool], None]) -> None:
        if self.full:
            done(False)
        else:
            MemoryLogStore.put(self, item, data, use, done)


def test_a_full_disk_loses_nothing_that_others_have() -> None:
    team = LogTeam("base", "spot")
    team.stop("base")
    disk = FullDisk(bytes(range(32)), clock=lambda: team.now)
    team.stores["base"] = disk
    team.start("base")
    team.separate()
    team.publish("spot", b"artifact")
    team.connect("base", "spot")
    team.run(10)
    assert team.read("base") == []
    assert team.nodes["spot"].logs()[0].missing_readers == (("base", 1),)
    disk.full = False
    team.run(40)
    assert team.read("base") == [("spot", 1, b"artifact")]


def test_a_full_disk_at_the_source_is_reported() -> None:
    team = LogTeam("base", "spot")
    team.stop("spot")
    team.stores["spot"] = FullDisk(bytes(range(32)), clock=lambda: team.now)
    team.start("spot")
    team.publish("spot", b"artifact")
    team.run(1)
    assert [(event.number, event.reason) for event in dropped(team, "spot")] == [(1, ExpiryReason.DISK)]


class LossyDisk(MemoryLogStore):
    """Returns nothing that it stored."""

    def get(self, item: ItemId, done: Callable[[bytes | None], None]) -> None:
        done(None)


def test_an_item_that_the_disk_lost_comes_from_another_holder() -> None:
    team = LogTeam("base", "husky", "spot")
    team.publish("spot", b"artifact")
    team.meet("spot", "husky", seconds=5)
    lossy = LossyDisk(team.stores["spot"].seed, clock=lambda: team.now, items=team.stores["spot"].items)
    team.stop("spot")
    team.stores["spot"] = lossy
    team.start("spot")
    team.connect("base", "husky", "spot")
    team.run(20)
    assert team.read("base") == [("spot", 1, b"artifact")]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"reliable": False}, "expected reliable = true for a log"),
        ({"keep_last": 1}, "expected no keep_last for a log"),
        ({"deadline_s": 1.0}, "expected no deadline_s for a log"),
        ({"destinations": ("base",)}, "expected no destinations for a log"),
        ({"outbox": Outbox.ALL}, "expected no outbox for a log"),
        ({"repair": True}, "expected no repair for a log"),
        ({"name": "n" * 246}, "expected at most 245 bytes for the name of a log"),
    ],
)
def test_a_log_refuses_what_contradicts_it(changes: dict[str, object], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        Topic(**{"name": "artifact", "log": Log(), **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("limits", [{"max_items": 0}, {"max_bytes": 0}, {"max_age_s": 0.0}])
def test_impossible_limits_are_refused(limits: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"log\.max_"):
        Log(**limits)  # type: ignore[arg-type]
