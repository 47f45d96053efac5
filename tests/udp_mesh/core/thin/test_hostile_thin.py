"""Attackers on a thin link: without the key, with recordings of this and earlier runs, and a member that lies."""

from __future__ import annotations

import random

import pytest

from tests.udp_mesh.core.thin.fleet import ESTOP, KEY, REPORT, ThinFleet
from udp_mesh.core.events import ThinLinkRejecting
from udp_mesh.core.thin.forgeries import MAX_FAILURES, PERIOD_S
from udp_mesh.core.thin.link import MAX_ACKS, ThinLinkCounters
from udp_mesh.core.thin.outgoing import LIFE_S
from udp_mesh.core.thin.peers import MAX_TOKENS, PROOF_VALID_S
from udp_mesh.core.thin.reassembly import MAX_PARTIALS, MAX_PARTIALS_PER_SENDER, ThinReassembly
from udp_mesh.crypto import Key
from udp_mesh.crypto.thin import ThinChannel, thin_hint
from udp_mesh.wire.thin import HeardFrom, Part, ThinItem, ThinPresence, decode_header, encode_header, encode_item

OTHER = Key(bytes(range(100, 132)))


def met(*names: str, seed: int = 1) -> ThinFleet:
    fleet = ThinFleet(*names, seed=seed)
    assert fleet.run(300, fleet.met)
    return fleet


def inject(fleet: ThinFleet, at: str, frame: bytes) -> None:
    fleet._arrive(at, frame)


class Member:
    """A holder of the key that says what it wants."""

    def __init__(self, number: int, key: Key = KEY, tag: bytes = b"liar----") -> None:
        self.number, self.tag, self.counter = number, tag, 0
        self._key = key
        self._channel = ThinChannel(key, tag, number)

    def frame(self, *items: ThinItem, introduction: bool = False) -> bytes:
        header = encode_header(thin_hint(self._key), self.number, self.counter, self.tag if introduction else None)
        sealed = self._channel.seal(header, b"".join(map(encode_item, items)), self.counter)
        self.counter += 1
        return sealed

    def introduce(self, fleet: ThinFleet, at: str, name: str = "liar") -> None:
        """Become a proven node."""
        inject(fleet, at, self.frame(ThinPresence(name, 60), introduction=True))
        fleet.run(20)
        token = next(frame[-4:] for who, frame in reversed(fleet.frames) if who == at and frame[0] & 0x80)
        own = fleet.settings(at).thin.number
        assert own is not None
        inject(fleet, at, self.frame(ThinPresence(name, 60, (HeardFrom(own, token),)), introduction=True))


def counters(fleet: ThinFleet, name: str) -> ThinLinkCounters:
    return fleet.thin(name).links["radio"].counters


def test_frames_of_another_fleet_do_not_count_as_attempts() -> None:
    assert thin_hint(OTHER) != thin_hint(KEY)
    fleet = met("base", "husky")
    stranger = Member(9, OTHER)
    for _ in range(1000):
        inject(fleet, "base", stranger.frame(ThinPresence("stranger", 60), introduction=True))
    assert counters(fleet, "base").frames_foreign >= 1000
    assert fleet.thin("base").links["radio"].forgeries.total == 0
    assert fleet.peer("base", "stranger") is None


def test_after_a_bounded_number_of_forgeries_a_link_accepts_nothing_and_says_so() -> None:
    fleet = met("base", "husky")
    rng = random.Random(3)
    for attempt in range(2 * MAX_FAILURES):
        # New counters every time, as an attacker would; the tag is a guess.
        header = encode_header(thin_hint(KEY), 2, fleet.nodes["husky"]._state.thin_counter + 1 + attempt % 100, None)
        inject(fleet, "base", header + rng.randbytes(20))
    assert counters(fleet, "base").frames_forged == MAX_FAILURES
    assert counters(fleet, "base").frames_rejected >= MAX_FAILURES
    assert fleet.reported("base", ThinLinkRejecting) == [ThinLinkRejecting("radio", MAX_FAILURES)]
    [link] = fleet.conditions("base").links
    assert link.rejecting_s is not None
    assert link.failed_authentications == MAX_FAILURES
    fleet.send("husky", ESTOP.name, b"during")
    fleet.run(60)
    assert fleet.received("base") == []
    fleet.run(PERIOD_S)
    assert fleet.conditions("base").links[0].rejecting_s is None
    fleet.send("husky", ESTOP.name, b"after")
    assert fleet.run(60, lambda: fleet.received("base") == [b"after"])


def test_a_recorded_frame_of_this_run_counts_once() -> None:
    fleet = met("base", "husky")
    fleet.send("husky", ESTOP.name, b"stop")
    fleet.run(30)
    for _, frame in list(fleet.frames):
        inject(fleet, "base", frame)
    fleet.run(30)
    assert fleet.received("base") == [b"stop"]
    assert counters(fleet, "base").frames_replayed > 0


@pytest.mark.parametrize("restarted", ["base", "husky"])
def test_nothing_recorded_before_a_restart_counts_after_it(restarted: str) -> None:
    fleet = met("base", "husky")
    fleet.send("husky", ESTOP.name, b"stop")
    fleet.run(30)
    recorded = [frame for name, frame in fleet.frames if name == "husky"]
    # Until then husky itself sends it to nodes that appear.
    fleet.run(LIFE_S)
    fleet.start(restarted)
    assert fleet.run(300, fleet.met)
    fleet.events["base"].clear()
    for _ in range(3):
        for frame in recorded:
            inject(fleet, "base", frame)
            fleet.run(0.5)
    assert fleet.received("base") == []
    assert fleet.run(60, fleet.met)


def test_a_recording_that_never_arrived_is_worthless_once_the_sender_has_restarted() -> None:
    """The base did not hear the first run of husky at all; the attacker did, and plays it after the second began."""
    fleet = ThinFleet("base", "husky")
    assert fleet.run(300, fleet.met)
    fleet.start("husky")
    fleet.apart.add("base")
    fleet.run(1)
    fleet.send("husky", ESTOP.name, b"stop")
    fleet.run(30)
    unheard = [frame for name, frame in fleet.frames if name == "husky"][-10:]
    fleet.apart.clear()
    fleet.start("husky")
    assert fleet.run(300, fleet.met)
    for frame in unheard:
        inject(fleet, "base", frame)
        fleet.run(0.1)
    fleet.run(20)
    assert fleet.received("base") == []


def test_frames_held_back_for_long_are_dropped() -> None:
    """An attacker that holds everything back delays messages by a bounded time only."""
    fleet = met("base", "husky")
    held: list[bytes] = []

    def hold(name: str, frame: bytes) -> bytes | None:
        if name == "husky":
            held.append(frame)
            return None
        return frame

    fleet.on_frame = hold
    fleet.send("husky", ESTOP.name, b"stop")
    fleet.run(PROOF_VALID_S + 30)
    for frame in held[:3]:
        inject(fleet, "base", frame)
    assert fleet.received("base") == []


def test_replayed_introductions_do_not_use_up_the_budget() -> None:
    fleet = met("base", "husky")
    recorded = next(frame for name, frame in fleet.frames if name == "husky" and frame[0] & 0x80)
    fleet.start("base")
    fleet.run(5)
    before = fleet.medium.counts.airtime_s["base"]
    for _ in range(1000):
        inject(fleet, "base", recorded)
        fleet.run(0.5)
    assert (fleet.medium.counts.airtime_s["base"] - before) / 500 < 0.01


def test_changed_frames_are_dropped_and_the_link_still_works() -> None:
    fleet = met("base", "husky")
    rng = random.Random(5)

    def damage(name: str, frame: bytes) -> bytes:
        if rng.random() < 0.3:
            changed = bytearray(frame)
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
            return bytes(changed)
        return frame

    fleet.on_frame = damage
    for number in range(10):
        fleet.send("husky", ESTOP.name, bytes((number,)))
        fleet.run(30)
    assert fleet.received("base") == [bytes((number,)) for number in range(10)]


def test_a_member_with_this_nodes_number_or_a_peers_is_reported() -> None:
    fleet = met("base", "husky")
    inject(fleet, "base", Member(1).frame(ThinPresence("double", 60), introduction=True))
    assert fleet.conditions("base").own_number_used_by == "double"
    # A recording of an earlier run of its own is no other node.
    inject(fleet, "husky", Member(2).frame(ThinPresence("husky", 60), introduction=True))
    assert fleet.conditions("husky").own_number_used_by == ""
    fleet.apart.add("husky")
    fleet.run(30)
    Member(2).introduce(fleet, "base", "double")
    [peer] = fleet.conditions("base").peers
    assert (peer.name, peer.conflicting_name) == ("double", "husky")


def test_a_member_cannot_make_a_node_hold_or_remember_without_bound() -> None:
    fleet = met("base", "husky")
    liar = Member(9)
    liar.introduce(fleet, "base")
    thin = fleet.thin("base")
    for number in range(5000):
        part = Part(number & 0xFFFF, 0, True, None, 0, 32, b"ab", bytes(200))
        inject(fleet, "base", liar.frame(part))
    assert len(thin.reassembly) <= MAX_PARTIALS_PER_SENDER
    assert len(thin.links["radio"].acks) <= MAX_ACKS
    for number in range(5000):
        inject(fleet, "base", liar.frame(Part(number, 0, True, None, 0, 1, b"ab", b"\x00x")))
    assert fleet.conditions("base").unknown_topics > 0
    assert sum(map(len, fleet.nodes["base"]._state.thin_copies._boots.values())) <= 256 * 1024
    for number in range(3, 250):
        for run in range(3):
            other = Member(number, tag=bytes((number, run)) * 4)
            inject(fleet, "base", other.frame(ThinPresence(f"n{number}", 60), introduction=True))
    assert len(thin.peers.peers) <= 254
    assert len(thin.peers._tokens) <= MAX_TOKENS
    fleet.events["base"].clear()
    fleet.send("husky", ESTOP.name, b"stop")
    assert fleet.run(120, lambda: fleet.received("base") == [b"stop"])


def test_parts_of_many_senders_are_held_within_a_bound() -> None:
    reassembly = ThinReassembly()
    for number in range(1000):
        part = Part(number, 0, True, None, 1, 32, None, bytes(255))
        reassembly.receive(number.to_bytes(8, "big"), part, float(number) / 100)
    assert len(reassembly) == MAX_PARTIALS
    assert reassembly.held_bytes <= MAX_PARTIALS * 255
    reassembly.expire(1e6)
    assert len(reassembly) == 0


def test_a_nonce_is_never_used_twice() -> None:
    """Key, number and counter of all frames, over restarts."""
    fleet = met("base", "husky")
    for _ in range(5):
        fleet.send("husky", REPORT.name, bytes(200), "base")
        fleet.run(30)
        fleet.start("husky")
        fleet.run(30)
    assert len({frame[-4:] for _, frame in fleet.frames}) > 0.99 * len(fleet.frames)
    introductions = [decode_header(frame) for _, frame in fleet.frames if frame[0] & 0x80]
    used = [(header.boot_tag, header.counter_high, header.counter_low) for header in introductions]
    assert len(set(used)) == len(used)
