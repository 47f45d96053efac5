"""An alarm has a beginning and an end, and what an operator said about it stays with it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from meshctl.errors import InputError, MeshctlError
from meshctl.monitor.alarm_log import REOPEN_S, Silence
from meshctl.monitor.metrics import render_metrics
from meshctl.monitor.store import MIN_BYTES, FrameStore
from tests.meshctl.monitor.documents import frame

WEAK = {("b01", "weak"): "warning"}


@pytest.fixture
def store(tmp_path: Path) -> Iterator[FrameStore]:
    with FrameStore.open(tmp_path / "history.sqlite", 86400.0, MIN_BYTES) as opened:
        yield opened


def test_an_alarm_begins_continues_and_ends(store: FrameStore) -> None:
    both = {**WEAK, ("robot:rover", "disk"): "error", ("", "not-compared"): "note"}
    assert [one.key for one in store.append(frame(10.0, both))] == [
        ("b01", "weak"),
        ("robot:rover", "disk"),
        ("", "not-compared"),
    ]
    assert store.append(frame(20.0, WEAK)) == ()
    (weak,) = store.alarms(now_s=20.0)
    assert (weak.first_s, weak.last_s, weak.ended_s) == (10.0, 20.0, None)
    assert (weak.level, weak.text, weak.hint) == ("warning", "weak of b01", "look")
    everything = {one.key: one.ended_s for one in store.alarms(active_only=False, now_s=20.0)}
    assert everything == {("b01", "weak"): None, ("robot:rover", "disk"): 20.0, ("", "not-compared"): 20.0}


def test_several_of_one_code_are_one_alarm_of_the_highest_level(store: FrameStore) -> None:
    status = frame(10.0).document["status"]
    status["nodes"][1]["alarms"] = [
        {"level": "note", "code": "radio", "text": "radio0 is down", "hint": ""},
        {"level": "error", "code": "radio", "text": "radio1 is down", "hint": "look"},
        {"level": "absurd", "code": "radio", "text": "no level"},
        {"code": 7},
        "no alarm",
    ]
    (radio,) = store.append(type(frame(10.0)).of({"time_s": 10.0, "status": status}))
    assert (radio.level, radio.text, radio.hint) == ("error", "radio0 is down; radio1 is down", "look")


def test_an_alarm_of_a_device_that_does_not_answer_stays_open(store: FrameStore) -> None:
    store.append(frame(10.0, WEAK))
    began = store.append(frame(20.0, {("b01", "unreachable"): "error"}, silent=("b01",)))
    assert [one.code for one in began] == ["unreachable"]
    assert {one.code: one.last_s for one in store.alarms(now_s=20.0)} == {"unreachable": 20.0, "weak": 10.0}
    assert store.append(frame(30.0, WEAK)) == ()
    assert {one.code: one.last_s for one in store.alarms(now_s=30.0)} == {"weak": 30.0}


def test_a_flapping_alarm_is_one_and_a_later_one_is_new(store: FrameStore) -> None:
    store.append(frame(10.0, WEAK))
    store.acknowledge("b01", "weak", "alice", 15.0)
    store.append(frame(20.0))
    assert store.append(frame(20.0 + REOPEN_S, WEAK)) == ()
    (again,) = store.alarms(now_s=200.0)
    assert again.acknowledged is not None
    assert (again.first_s, again.acknowledged.by) == (10.0, "alice")
    store.append(frame(200.0))
    (new,) = store.append(frame(200.5 + REOPEN_S, WEAK))
    assert (new.first_s, new.acknowledged) == (200.5 + REOPEN_S, None)
    assert [one.acknowledged is None for one in store.alarms(active_only=False, now_s=400.0)] == [True, False]


def test_an_alarm_that_becomes_an_error_is_reported_again_and_needs_its_own_acknowledgment(store: FrameStore) -> None:
    error = {("b01", "weak"): "error"}
    store.append(frame(10.0, WEAK))
    store.acknowledge("b01", "weak", "alice", 11.0)
    (worse,) = store.append(frame(20.0, error))
    assert (worse.level, worse.first_s) == ("error", 10.0)
    (weak,) = store.alarms(now_s=20.0)
    assert weak.acknowledged is None
    # it was an error before: nothing new, and its acknowledgment stays
    store.acknowledge("b01", "weak", "bob", 21.0)
    assert store.append(frame(30.0, WEAK)) == ()
    assert store.append(frame(40.0, error)) == ()
    (weak,) = store.alarms(now_s=40.0)
    assert weak.acknowledged is not None
    assert weak.acknowledged.by == "bob"


def test_an_alarm_that_becomes_an_error_while_the_disk_is_full_loses_its_acknowledgment(
    store: FrameStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.append(frame(10.0, WEAK))
    store.acknowledge("b01", "weak", "alice", 11.0)

    def full(*arguments: object) -> None:
        raise MeshctlError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(store, "_write", full)
        store.append(frame(20.0, {("b01", "weak"): "error"}))
    store.append(frame(30.0, {("b01", "weak"): "error"}))
    (weak,) = store.alarms(now_s=30.0)
    assert (weak.level, weak.acknowledged) == ("error", None)


def test_open_alarms_are_known_to_the_next_process(tmp_path: Path) -> None:
    with FrameStore.open(tmp_path / "one", 86400.0, MIN_BYTES) as store:
        store.append(frame(10.0, WEAK))
    with FrameStore.open(tmp_path / "one", 86400.0, MIN_BYTES) as store:
        assert store.append(frame(20.0, WEAK)) == ()
        assert store.append(frame(30.0)) == ()
        assert store.alarms(now_s=30.0) == ()
    with FrameStore.open(tmp_path / "one", 86400.0, MIN_BYTES) as store:
        assert store.append(frame(40.0, WEAK)) == (), "it continues, also in another process"


def test_only_an_open_alarm_is_acknowledged(store: FrameStore) -> None:
    with pytest.raises(InputError, match="b01 has no open alarm weak"):
        store.acknowledge("b01", "weak", "alice", 1.0)
    with pytest.raises(InputError, match="the fleet has no open alarm stranger"):
        store.acknowledge("", "stranger", "alice", 1.0)
    store.append(frame(10.0, WEAK))
    store.acknowledge("b01", "weak", "alice", 11.0)
    store.append(frame(12.0, WEAK))
    (weak,) = store.alarms(now_s=12.0)
    assert weak.as_json()["acknowledged"] == {"by": "alice", "at_s": 11.0}


def test_a_silence_covers_later_alarms_until_it_ends(store: FrameStore) -> None:
    store.silence("b01", "weak", Silence(50.0, "being carried", "bob"), 0.0)
    store.silence("*", "clock", Silence(None, "no NTP in the mine", "bob"), 0.0)
    store.append(frame(10.0, {**WEAK, ("b02", "clock"): "note", ("b02", "weak"): "warning"}))

    def reasons(now_s: float) -> dict[tuple[str, str], str | None]:
        return {a.key: a.silenced.reason if a.silenced else None for a in store.alarms(now_s=now_s)}

    silenced = {("b01", "weak"): "being carried", ("b02", "clock"): "no NTP in the mine", ("b02", "weak"): None}
    assert reasons(49.0) == silenced
    assert reasons(50.0) == {**silenced, ("b01", "weak"): None}
    store.end_silence("*", "clock", "bob", 0.0)
    assert set(reasons(51.0).values()) == {None}
    with pytest.raises(InputError, match="has no silence"):
        store.end_silence("*", "clock", "bob", 0.0)
    with pytest.raises(InputError, match="reason"):
        store.silence("b01", "weak", Silence(None, "  ", "bob"), 0.0)
    with pytest.raises(InputError, match="unknown device 'b07'"):
        store.silence("b07", "weak", Silence(None, "gone", "bob"), 0.0)
    store.silence("robot:rover", "disk", Silence(None, "known", "bob"), 0.0)


def test_silences_are_in_force_by_the_wall_clock_also_while_frames_are_ahead_of_it(store: FrameStore) -> None:
    store.silence("b01", "weak", Silence(50.0, "being carried", "bob"), 0.0)
    # the clock was set back: frames go on from the later time
    (began,) = store.append(frame(1000.0, WEAK), now_s=40.0)
    assert began.silenced is not None
    for now_s, silenced in ((40.0, "true"), (60.0, "false")):
        assert f'device="b01",code="weak",level="warning",acknowledged="false",silenced="{silenced}"' in render_metrics(
            store.latest(), store, now_s
        )
