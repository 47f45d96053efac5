"""Any bytes at every decoder of the network: frames within their caps, or a counted drop, never an exception.

`make test` runs 4,000 inputs per surface. The proof runs `UDP_MESH_FUZZ_INPUTS` inputs over all surfaces: 10^8 by
default, some hours of one core. `RAN` is what was really run. Inputs are random bytes, mutations of real datagrams, and
sealed frames of a key holder; a third of them comes from an IPv6 address.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import pytest

from tests.udp_mesh.core.pair import Pair, pair, settings
from tests.udp_mesh.wire.make_vectors import FRAMES, LEGACY, MESH_DATA
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.node import Node
from udp_mesh.core.settings import Limits, LinkInfo, LinkKind, Neighbour
from udp_mesh.crypto import TO_ALL, SendChannel
from udp_mesh.wire.codec import decode, encode
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.legacy import encode_legacy, encode_mesh_data, fragment_legacy

RAN = 1_200_000
"""Inputs of the largest single run of the proof; update it after a larger run."""

INPUTS = int(os.environ.get("UDP_MESH_FUZZ_INPUTS", "100000000"))
FOUR, SIX = ("10.0.0.66", 8700), ("fe80::66", 8700)
OLD = ("10.0.0.9", 8700)
A = ("10.0.0.1", 8700)
FRESH_PAIR_EVERY = 20_000
"""Inputs after which both nodes are replaced: growth shows by then, and stuck state does not hide other failures."""


class Fuzzer:
    """One pair of nodes, a dual-stack link each, and a random source."""

    def __init__(self, seed: int) -> None:
        self.dice = random.Random(seed)
        self.inputs = 0
        self.seeds = [encode(frames) for frames in FRAMES.values()]
        whole = fragment_legacy(encode_mesh_data(MESH_DATA))
        self.old = [encode_legacy(datagram) for datagram in LEGACY.values()] + whole
        self.both = self.new_pair()
        self.recorded: list[bytes] = []

    def new_pair(self) -> Pair:
        limits = Limits(partial_bytes=2_000_000, peers=64, strangers=16)
        both = pair(limits=limits)
        config = settings("b", limits=limits, neighbours=(Neighbour(OLD, name="old", legacy=True),))
        both.b.apply(config, both.now)
        both.b.link_up(LinkInfo("six", LinkKind.BROADCAST, ("fe80::2", 8700), ("ff02::1", 8700)), both.now)
        for node, other in ((both.a, "b"), (both.b, "a")):
            node.send("any", b"hello", destination=other, now=both.now)
        both.roundtrip(times=30)
        self.insider = both.a._state.peer_table.peers["b"].session
        self.stranger = SendChannel(both.a._state.keys[0], self.dice.randbytes(16), TO_ALL)
        return both

    def mutated(self, data: bytes) -> bytes:
        raw = bytearray(data)
        for _ in range(self.dice.randint(1, 6)):
            match self.dice.randrange(4) if raw else 2:
                case 0:
                    odd = self.dice.choice((0, 1, 0x7F, 0x80, 0xFF, self.dice.randrange(256)))
                    raw[self.dice.randrange(len(raw))] = odd
                case 1:
                    del raw[self.dice.randrange(len(raw)) :]
                case 2:
                    at = self.dice.randint(0, len(raw))
                    raw[at:at] = self.dice.randbytes(self.dice.randint(1, 8))
                case _:
                    raw += self.dice.choice(self.seeds)
        return bytes(raw)

    def frames(self) -> bytes:
        """Frames of a key holder: mutations of real ones, sometimes none at all."""
        return b"" if self.dice.random() < 0.01 else self.mutated(self.dice.choice(self.seeds))

    def node(self) -> Node:
        return self.both.b

    def receive(self, data: bytes) -> None:
        link, source = self.dice.choice((("mesh", FOUR), ("six", SIX), ("mesh", A)))
        self.node().receive(data, link, source, self.both.now)

    def step(self, surface: Callable[[Fuzzer], None]) -> None:
        surface(self)
        self.inputs += 1
        if self.inputs % 200 == 0:
            self.both.now += 0.05
            for node in (self.both.b, self.both.a):
                node.handle_timer(self.both.now)
                while node.datagrams_to_send(self.both.now):
                    pass
                while node.next_event() is not None:
                    pass
        if self.inputs % FRESH_PAIR_EVERY == 0:
            state = self.both.b._state
            assert state.peer_table.memory.bytes <= 2_000_000
            assert len(state.peer_table.peers) <= 64 + 1
            self.both = self.new_pair()


def random_bytes(fuzzer: Fuzzer) -> None:
    first = fuzzer.dice.choice((0x90, 0x91, 0x92, 0x93, 1, 2, 4, 5, fuzzer.dice.randrange(256)))
    fuzzer.receive(bytes((first,)) + fuzzer.dice.randbytes(fuzzer.dice.randint(0, 120)))


def decoder(fuzzer: Fuzzer) -> None:
    try:
        decode(fuzzer.frames())
    except DecodeError:
        return


def sealed_data(fuzzer: Fuzzer) -> None:
    """To one boot, short and long headers."""
    assert fuzzer.insider is not None
    path = fuzzer.insider.path
    seal = path.channel.seal if fuzzer.dice.random() < 0.7 else path.channel.seal_long
    number, data = seal(fuzzer.frames())
    fuzzer.both.a._state.peer_table.peers["b"].open_sender().in_flight.add(number, None)
    fuzzer.receive(data)


def sealed_to_all(fuzzer: Fuzzer) -> None:
    channel = fuzzer.both.a._state.broadcast_channel if fuzzer.dice.random() < 0.7 else fuzzer.stranger
    seal = channel.seal if fuzzer.dice.random() < 0.5 else channel.seal_long
    fuzzer.receive(seal(fuzzer.frames())[1])


def mutated_datagrams(fuzzer: Fuzzer) -> None:
    """Sealed datagrams modified in transit: they cannot be opened."""
    assert fuzzer.insider is not None
    number, data = fuzzer.insider.path.channel.seal(fuzzer.dice.choice(fuzzer.seeds))
    fuzzer.both.a._state.peer_table.peers["b"].open_sender().in_flight.add(number, None)
    fuzzer.receive(fuzzer.mutated(data))


def legacy(fuzzer: Fuzzer) -> None:
    data = fuzzer.mutated(fuzzer.dice.choice(fuzzer.old))
    fuzzer.node().receive(data, "mesh", OLD, fuzzer.both.now)


SURFACES = (random_bytes, decoder, sealed_data, sealed_to_all, mutated_datagrams, legacy)


@pytest.mark.parametrize("surface", SURFACES)
def test_any_bytes_are_taken_or_counted(surface: Callable[[Fuzzer], None]) -> None:
    fuzzer = Fuzzer(seed=SURFACES.index(surface))
    for _ in range(4_000):
        fuzzer.step(surface)


def test_after_any_bytes_the_pair_still_talks() -> None:
    fuzzer = Fuzzer(seed=77)
    for _ in range(3000):
        fuzzer.step(fuzzer.dice.choice((random_bytes, mutated_datagrams, legacy)))
    both = fuzzer.both
    both.roundtrip(times=30)
    both.events(both.b)
    both.a.send("any", b"still here", destination="b", now=both.now)
    both.roundtrip(times=100)
    assert any(isinstance(event, MessageReceived) and event.payload == b"still here" for event in both.events(both.b))


@pytest.mark.proof
@pytest.mark.parametrize("surface", SURFACES)
def test_a_hundred_million_inputs(surface: Callable[[Fuzzer], None]) -> None:
    """`UDP_MESH_FUZZ_INPUTS` of them, an equal part for each surface."""
    fuzzer = Fuzzer(seed=int.from_bytes(os.urandom(4), "big"))
    for _ in range(-(-INPUTS // len(SURFACES))):
        fuzzer.step(surface)
