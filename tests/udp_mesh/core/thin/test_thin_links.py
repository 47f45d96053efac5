"""Thin links in virtual time: who is heard, what is carried, each message once, over whatever link."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.udp_mesh.core.thin.fleet import ESTOP, KEY, POSITION, RADIO, REPORT, ThinFleet
from udp_mesh.core.events import (
    ExpiryReason,
    MessageDelivered,
    MessageExpired,
    Rejected,
    RejectReason,
    ThinPeerHeard,
    ThinPeerSilent,
)
from udp_mesh.core.peers import features, heartbeat
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.core.thin.settings import ThinLinkSettings, ThinSettings
from udp_mesh.crypto import Key
from udp_mesh.wire.frames import Feature

SLOW = ThinLinkSettings("lora", bits_per_s=1_074, frame_bytes=230, frame_overhead_bytes=16)


def met(*names: str, **changes: object) -> ThinFleet:
    fleet = ThinFleet(*names, **changes)  # type: ignore[arg-type]
    assert fleet.run(300, fleet.met)
    return fleet


@pytest.mark.parametrize("seed", range(8))
def test_nodes_know_each_other_soon_and_then_send_little(seed: int) -> None:
    fleet = met("base", "husky", "spot", "uav", seed=seed, loss=0.1)
    assert fleet.now < 40
    before = dict(fleet.medium.counts.airtime_s)
    fleet.run(600)
    assert fleet.met()
    for name, airtime_s in fleet.medium.counts.airtime_s.items():
        assert (airtime_s - before[name]) / 600 < 0.01


@pytest.mark.parametrize("timers_late_s", [0.001, 0.3, 5.0])
def test_nodes_whose_timers_come_late_meet_and_are_quiet(timers_late_s: float) -> None:
    """The fleet fails once a timer stays in the past."""
    fleet = met("base", "husky", "spot", loss=0.1, timers_late_s=timers_late_s)
    fleet.send("base", "estop", b"stop")
    fleet.send("husky", "report", bytes(300), "base")
    fleet.run(200)
    assert fleet.received("spot", "estop") == [b"stop"]
    assert fleet.received("base", "report") == [bytes(300)]


@pytest.mark.parametrize("frame_bytes", [40, 41, 51])
def test_the_longest_name_that_fits_a_frame_is_heard_and_a_longer_one_refused(frame_bytes: int) -> None:
    """A node whose presence did not fit composed it again and again, and used a whole processor core."""
    link = replace(RADIO, frame_bytes=frame_bytes)
    longest = frame_bytes - 28
    met("n" * longest, "m" * longest, "k" * longest, link=link)
    with pytest.raises(ValueError, match=f"name: expected a name of at most {longest} bytes, because frames of thin"):
        ThinFleet("n" * (longest + 1), link=link)


def test_a_silent_node_is_reported_and_forgotten_a_returning_one_is_back() -> None:
    fleet = met("base", "husky")
    fleet.apart.add("husky")
    fleet.run(200)
    assert [event.peer for event in fleet.reported("base", ThinPeerSilent) if isinstance(event, ThinPeerSilent)] == [
        "husky"
    ]
    fleet.apart.clear()
    assert fleet.run(60, fleet.met)
    assert len(fleet.reported("base", ThinPeerHeard)) == 2


@pytest.mark.parametrize("seed", range(20))
def test_a_robot_without_wifi_hears_an_emergency_stop_once(seed: int) -> None:
    fleet = met("base", "husky", "spot", seed=seed, loss=0.2)
    begin = fleet.now
    fleet.send("base", ESTOP.name, b"stop")
    assert fleet.run(30, lambda: all(fleet.received(name) for name in ("husky", "spot")))
    assert fleet.now - begin < 15
    fleet.run(200)
    assert fleet.received("husky") == fleet.received("spot") == [b"stop"]


def test_an_urgent_message_takes_all_links_and_arrives_once() -> None:
    fleet = met("base", "husky")
    fleet.wifi = {"base", "husky"}
    assert fleet.run(10, lambda: any(peer.online for peer in fleet.nodes["base"].conditions(fleet.now).peers))
    for number in range(5):
        fleet.send("base", ESTOP.name, bytes((number,)))
        fleet.run(10)
    assert fleet.received("husky") == [bytes((number,)) for number in range(5)]
    assert fleet.conditions("husky").copies_dropped >= 1
    assert fleet.thin("base").links["radio"].counters.parts_sent >= 5


def test_the_thin_copy_comes_first_and_the_datagrams_later() -> None:
    """Reliable, to one peer: the wifi comes back after the thin link has delivered the message."""
    fleet = met("base", "husky")
    fleet.wifi = {"base", "husky"}
    fleet.run(10)
    fleet.wifi.clear()
    message = fleet.send("base", ESTOP.name, b"stop", "husky")
    assert fleet.run(20, lambda: bool(fleet.reported("base", MessageDelivered)))
    fleet.run(30)
    fleet.wifi = {"base", "husky"}
    fleet.run(60)
    assert fleet.received("husky") == [b"stop"]
    delivered = fleet.reported("base", MessageDelivered)
    assert [event.message_id for event in delivered if isinstance(event, MessageDelivered)] == [message]


def test_other_messages_of_marked_topics_use_thin_links_only_while_they_must() -> None:
    fleet = met("base", "husky", "spot")
    fleet.wifi = {"base", "husky", "spot"}
    fleet.run(10)
    fleet.send("husky", REPORT.name, b"all fine", "base")
    fleet.run(10)
    assert fleet.thin("husky").links["radio"].counters.parts_sent == 0
    fleet.wifi = {"base", "spot"}
    fleet.run(20)
    fleet.send("husky", REPORT.name, b"no wifi", "base")
    fleet.send("husky", "map", b"never on a thin link", "base")
    fleet.run(30)
    assert fleet.received("base") == [b"all fine", b"no wifi"]


def test_a_robot_without_wifi_reports_its_position_at_the_interval_of_the_topic() -> None:
    fleet = met("base", "husky")
    begin = len(fleet.received("base"))
    for second in range(300):
        fleet.send("husky", POSITION.name, str(second).encode())
        fleet.run(1.0)
    positions = [int(payload) for payload in fleet.received("base", POSITION.name)[begin:]]
    assert 300 / 30 - 2 <= len(positions) <= 300 / 30 + 1
    assert positions == sorted(positions)
    # The newest one was sent, not one that had waited.
    ages = [
        at - float(payload)
        for (at, event), payload in zip(
            [(at, event) for at, event in fleet.events["base"] if getattr(event, "topic", "") == POSITION.name],
            positions,
            strict=True,
        )
    ]
    assert max(ages) - min(ages) < 5


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_a_message_of_many_parts_arrives_and_is_reported(loss: float) -> None:
    fleet = met("base", "husky", loss=loss, seed=4)
    payload = bytes(range(256)) * 5
    message = fleet.send("husky", REPORT.name, payload, "base")
    assert fleet.run(300, lambda: bool(fleet.reported("husky", MessageDelivered)))
    assert fleet.received("base") == [payload]
    [event] = fleet.reported("husky", MessageDelivered)
    assert isinstance(event, MessageDelivered)
    assert (event.message_id, event.peer, event.topic) == (message, "base", REPORT.name)
    repeated = fleet.thin("husky").links["radio"].counters.parts_repeated
    # Without loss, two frames may collide.
    assert repeated < (0.4 if loss == 0 else 4) * len(payload) / RADIO.frame_bytes


def test_an_urgent_message_overtakes_the_parts_of_a_long_one() -> None:
    fleet = met("base", "husky", link=SLOW)
    fleet.send("husky", REPORT.name, bytes(5000), "base")
    fleet.run(3)
    begin = fleet.now
    fleet.send("husky", ESTOP.name, b"stop")
    assert fleet.run(60, lambda: fleet.received("base") == [b"stop"])
    frame_s = SLOW.airtime_s(SLOW.frame_bytes)
    # Behind the frame on the air, and its own.
    assert fleet.now - begin < 3 * frame_s
    assert fleet.run(300, lambda: len(fleet.received("base")) == 2)


def test_a_message_too_large_for_thin_links_is_counted_and_takes_the_others() -> None:
    fleet = met("base", "husky")
    fleet.wifi = {"base", "husky"}
    fleet.run(10)
    fleet.send("base", ESTOP.name, bytes(3000))
    fleet.run(10)
    assert [len(payload) for payload in fleet.received("husky")] == [3000]
    assert fleet.conditions("base").too_large == 1


def test_a_peer_that_only_thin_links_reach_ends_a_message_as_expired_if_it_is_silent() -> None:
    fleet = met("base", "husky")
    fleet.apart.add("husky")
    message = fleet.send("base", ESTOP.name, b"stop", "husky")
    assert isinstance(message, int)
    fleet.run(200)
    [event] = fleet.reported("base", MessageExpired)
    assert isinstance(event, MessageExpired)
    assert (event.message_id, event.peer) == (message, "husky")
    assert isinstance(fleet.send("base", ESTOP.name, b"stop", "stranger"), Rejected)
    other = fleet.send("base", "map", b"map", "husky")
    assert isinstance(other, Rejected)
    assert other.reason is RejectReason.UNKNOWN_PEER


@pytest.mark.parametrize("topic", [ESTOP.name, REPORT.name])
@pytest.mark.parametrize("silent", [True, False], ids=["out of range of the thin link", "thin link works"])
def test_what_only_thin_links_carry_takes_the_wifi_of_a_robot_that_appears_there(topic: str, silent: bool) -> None:
    fleet = met("base", "husky")
    if silent:
        fleet.apart.add("husky")
    message = fleet.send("base", topic, b"return" + bytes(300), "husky")
    assert isinstance(message, int)
    fleet.run(0.1)
    assert fleet.received("husky") == []
    fleet.wifi |= {"base", "husky"}
    assert fleet.run(8, until=lambda: bool(fleet.reported("base", MessageDelivered)))
    fleet.run(200)
    assert len(fleet.received("husky", topic)) == 1
    [event] = fleet.reported("base", MessageDelivered)
    assert isinstance(event, MessageDelivered)
    assert (event.message_id, event.peer) == (message, "husky")
    assert fleet.reported("base", MessageExpired) == []


def test_a_node_that_closes_ends_what_only_thin_links_carry() -> None:
    fleet = met("base", "husky")
    fleet.apart.add("husky")
    message = fleet.send("base", ESTOP.name, b"stop", "husky")
    fleet.nodes["base"].close(fleet.now)
    fleet.pump("base")
    assert fleet.reported("base", MessageExpired) == [
        MessageExpired(message, "husky", ESTOP.name, ExpiryReason.CLOSED)  # type: ignore[arg-type]
    ]


def test_changed_links_start_again_without_using_a_number_twice() -> None:
    fleet = met("base", "husky")
    message = fleet.send("husky", REPORT.name, bytes(1500), "base")
    sent = fleet.nodes["husky"]._state.thin_counter
    for name in ("base", "husky"):
        one = fleet.settings(name)
        changed = replace(one, thin=replace(one.thin, links=(replace(RADIO, frame_bytes=100),)))
        assert "thin links" in fleet.nodes[name].apply(changed, fleet.now)
        fleet.pump(name)
    assert fleet.reported("husky", MessageExpired) == [
        MessageExpired(message, "base", REPORT.name, ExpiryReason.CLOSED)  # type: ignore[arg-type]
    ]
    assert fleet.run(60, fleet.met)
    assert fleet.nodes["husky"]._state.thin_counter > sent
    fleet.send("base", ESTOP.name, b"stop")
    assert fleet.run(30, lambda: fleet.received("husky") == [b"stop"])
    for name in ("base", "husky"):
        fleet.nodes[name].apply(replace(fleet.settings(name), thin=ThinSettings()), fleet.now)
        assert fleet.nodes[name].thin is None


def test_an_urgent_message_reaches_a_robot_that_restarts_meanwhile() -> None:
    fleet = met("base", "husky")
    fleet.apart.add("husky")
    fleet.run(100)
    fleet.send("base", ESTOP.name, b"stop")
    fleet.run(20)
    fleet.events["husky"].clear()
    fleet.apart.clear()
    fleet.start("husky")
    assert fleet.run(100, lambda: fleet.received("husky") == [b"stop"])


def test_the_budget_of_a_regulated_band_holds_under_a_flood_of_messages() -> None:
    link = ThinLinkSettings("eu868", bits_per_s=5_470, frame_bytes=120, duty_cycle=0.01)
    fleet = ThinFleet("base", "husky", link=link, seed=2)
    fleet.run(2000)
    for second in range(4000):
        fleet.send("husky", REPORT.name, second.to_bytes(4, "big") * 20)
        if second % 100 == 0:
            fleet.send("husky", ESTOP.name, b"stop %d" % second)
        fleet.run(1.0)
    sent = [(at, s) for at, name, s in fleet.medium.sent if name == "husky"]
    for begin in (at for at, _ in sent):
        assert sum(s for at, s in sent if begin <= at < begin + link.window_s) <= 0.01 * link.window_s
    assert len(fleet.received("base", ESTOP.name)) == 40


def test_each_link_carries_only_its_topics() -> None:
    fleet = met("base", "husky", topics=(Topic("estop", priority=0, thin=True, links=("another",)),))
    fleet.send("base", "estop", b"stop")
    fleet.run(30)
    assert fleet.received("husky") == []


def test_beside_a_node_of_an_earlier_version_everybody_gets_each_message_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """It announces no THIN: its datagrams have no number, the others' do."""
    original = heartbeat.own_features

    def old(settings: Settings) -> int:
        return original(settings) & ~(Feature.THIN if settings.name == "old" else 0)

    monkeypatch.setattr(heartbeat, "own_features", old)
    monkeypatch.setattr(features, "own_features", old)
    fleet = ThinFleet("base", "husky", "old")
    fleet.apart.add("old")
    fleet.wifi = {"base", "husky", "old"}
    assert fleet.run(60, fleet.met)
    fleet.run(10)
    for payload in (b"one", b"two"):
        fleet.send("base", ESTOP.name, payload)
        fleet.run(20)
    fleet.send("base", ESTOP.name, b"three", "old")
    fleet.run(20)
    assert fleet.received("husky") == [b"one", b"two"]
    assert fleet.received("old") == [b"one", b"two", b"three"]


def test_a_changed_key_is_taken_over_while_running() -> None:
    fleet = met("base", "husky")
    new = Key(bytes(range(1, 33)))
    for keys in ((KEY, new), (new, KEY), (new,)):
        for name in ("base", "husky"):
            fleet.nodes[name].apply(replace(fleet.settings(name), keys=keys), fleet.now)
        fleet.run(60)
        fleet.send("base", ESTOP.name, keys[0].key_id)
        fleet.run(30)
    assert fleet.received("husky") == [KEY.key_id, new.key_id, new.key_id]


def test_settings_that_cannot_work_are_refused() -> None:
    with pytest.raises(ValueError, match="expected this node's number"):
        ThinSettings(None, (RADIO,))
    with pytest.raises(ValueError, match="expected each name once"):
        ThinSettings(1, (RADIO, RADIO))
    with pytest.raises(ValueError, match="expected no compression, delta or log"):
        Topic("map", thin=True, delta=True)
