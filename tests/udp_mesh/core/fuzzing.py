"""Fuzz every decoder of the network: `python -m tests.udp_mesh.core.fuzzing --inputs 100000000`.

Inputs are random bytes, mutations of real datagrams, and sealed frames of a key holder; they come from two IPv4 and
one IPv6 address. The work is split into chunks of one surface and one seed each. Each finished chunk is a line in the
record, so the same command continues an interrupted run, and `--part 1/2` and `--part 2/2` share one. An exception or
an exceeded bound ends the run with the chunk's seed.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from tests.udp_mesh.core.fuzzed_nodes import FuzzedLine, FuzzedLogs, FuzzedMessages, FuzzedRelay
from tests.udp_mesh.core.hostile_peer import HostilePeer
from tests.udp_mesh.core.pair import Pair, pair, settings
from tests.udp_mesh.core.thin.fleet import RADIO, ThinFleet
from tests.udp_mesh.wire.make_vectors import FRAMES, LEGACY, MESH_DATA
from tests.udp_mesh.wire.thin_vectors import ITEMS
from udp_mesh.core.settings import Limits, LinkInfo, LinkKind, Neighbour
from udp_mesh.core.thin.link import MAX_ACKS, MAX_QUEUED, ComposedFrame
from udp_mesh.core.thin.reassembly import MAX_PARTIALS
from udp_mesh.crypto import TO_ALL, SendChannel
from udp_mesh.wire.codec import decode, encode
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.frames import MessageFlag
from udp_mesh.wire.legacy import encode_legacy, encode_mesh_data, fragment_legacy
from udp_mesh.wire.limits import MAX_THIN_NUMBER
from udp_mesh.wire.thin import encode_item

RECORD = Path("build/fuzz.jsonl")
CHUNK_INPUTS = 250_000
FRESH_PAIR_EVERY = 20_000
"""Inputs after which both nodes are replaced: growth shows by then, and stuck state does not hide other failures."""
TIMERS_EVERY = 200
MAX_PARTIAL_BYTES, MAX_PEERS, MAX_STRANGERS = 2_000_000, 64, 16
Running = FuzzedRelay | FuzzedLogs | FuzzedMessages | HostilePeer
LEGACY_ADDRESS = ("10.0.0.9", 8700)
SOURCES = (("mesh", ("10.0.0.66", 8700)), ("six", ("fe80::66", 8700)), ("mesh", ("10.0.0.1", 8700)))
_BOUNDARIES = bytes((0, 1, 0x7F, 0x80, 0xFF))


class Fuzzer:
    """One pair of nodes, a dual-stack link each, and a random source."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.inputs = 0
        self.seeds = [encode(frames) for frames in FRAMES.values()]
        self.legacy_seeds = [*map(encode_legacy, LEGACY.values()), *fragment_legacy(encode_mesh_data(MESH_DATA))]
        self.pair = self._new_pair()
        self.thin = self._new_thin()
        self.line = FuzzedLine()

    # Made where their surfaces are run: to let them meet takes longer than most other surfaces.
    @cached_property
    def relay(self) -> FuzzedRelay:
        return FuzzedRelay(self.rng.getrandbits(32))

    @cached_property
    def logs(self) -> FuzzedLogs:
        return FuzzedLogs(self.rng.getrandbits(32))

    @cached_property
    def messages(self) -> FuzzedMessages:
        return FuzzedMessages(self.rng.getrandbits(32))

    @cached_property
    def hostile(self) -> HostilePeer:
        return HostilePeer(self.rng.getrandbits(32))

    def _running(self) -> dict[str, Running]:
        return {name: value for name, value in vars(self).items() if isinstance(value, Running)}

    def _new_thin(self) -> ThinFleet:
        fleet = ThinFleet("a", "b", seed=self.rng.getrandbits(32))
        fleet.run(300, fleet.met)
        self.thin_seeds = [encode_item(item) for item in ITEMS.values()]
        return fleet

    def receive_thin(self, frame: bytes) -> None:
        self.thin.nodes["b"].receive(frame, RADIO.name, ("", 0), self.thin.now)

    def _new_pair(self) -> Pair:
        limits = Limits(partial_bytes=MAX_PARTIAL_BYTES, peers=MAX_PEERS, strangers=MAX_STRANGERS)
        both = pair(limits=limits)
        legacy = Neighbour(LEGACY_ADDRESS, name="old", legacy=True)
        both.b.apply(settings("b", limits=limits, neighbours=(legacy,)), both.now)
        both.b.link_up(LinkInfo("six", LinkKind.BROADCAST, ("fe80::2", 8700), ("ff02::1", 8700)), both.now)
        for node, other in ((both.a, "b"), (both.b, "a")):
            node.send("any", b"hello", destination=other, now=both.now)
        both.roundtrip(times=30)
        peer = both.a._state.peer_table.peers["b"]
        assert peer.session is not None
        self.insider, self.sent_packets = peer.session, peer.open_sender().in_flight
        self.stranger = SendChannel(both.a._state.keys[0], self.rng.randbytes(16), TO_ALL)
        return both

    def mutated(self, data: bytes) -> bytes:
        """One to six changes. Each takes its choices from one draw: drawing them singly costs more than decoding."""
        raw = bytearray(data)
        draw = self.rng.getrandbits
        for _ in range(1 + draw(8) % 6):
            bits = draw(96)
            kind, value, place, many = bits & 3, bits >> 2 & 0xFFF, bits >> 14 & 0xFFFF, bits >> 30 & 7
            if not raw or kind == 2:
                at = place % (len(raw) + 1)
                raw[at:at] = (bits >> 32).to_bytes(8, "big")[: 1 + many]
            elif kind == 0:
                raw[place % len(raw)] = _BOUNDARIES[value % 5] if value & 0x800 else value & 0xFF
            elif kind == 1:
                del raw[place % len(raw) :]
            else:
                raw += self.seeds[place % len(self.seeds)]
        return bytes(raw)

    def seed_datagram(self) -> bytes:
        return self.seeds[self.rng.getrandbits(16) % len(self.seeds)]

    def frames(self) -> bytes:
        """Frames of a key holder: mutations of real ones, sometimes none at all."""
        return self.mutated(self.seed_datagram()) if self.rng.getrandbits(7) else b""

    def receive(self, data: bytes) -> None:
        link, source = SOURCES[self.rng.getrandbits(16) % len(SOURCES)]
        self.pair.b.receive(data, link, source, self.pair.now)

    def run(self, surface: Callable[[Fuzzer], None], inputs: int) -> None:
        for _ in range(inputs):
            surface(self)
            self.inputs += 1
            if self.inputs % TIMERS_EVERY == 0:
                self._let_nodes_work()
            if self.inputs % FRESH_PAIR_EVERY == 0:
                self.check_bounds()
                self.pair = self._new_pair()
                self.thin = self._new_thin()
                for name in self._running():
                    delattr(self, name)

    def _let_nodes_work(self) -> None:
        self.pair.now += 0.05
        self.thin.run(0.05)
        for running in self._running().values():
            running.run(0.05)
        for node in (self.pair.b, self.pair.a):
            node.handle_timer(self.pair.now)
            while node.datagrams_to_send(self.pair.now):
                pass
            while node.next_event() is not None:
                pass

    def check_bounds(self) -> None:
        """Raises AssertionError if the node holds more than its limits allow."""
        for running in self._running().values():
            running.check_bounds()
        thin = self.thin.thin("b")
        assert len(thin.reassembly) <= MAX_PARTIALS
        assert len(thin.peers.peers) <= MAX_THIN_NUMBER
        assert all(len(link.acks) <= MAX_ACKS and len(link.queue) <= MAX_QUEUED for link in thin.links.values())
        table = self.pair.b._state.peer_table
        assert table.memory.bytes <= MAX_PARTIAL_BYTES
        assert len(table.peers) <= MAX_PEERS + 1
        assert len(table.not_current()) <= MAX_STRANGERS + MAX_PEERS


def random_bytes(fuzzer: Fuzzer) -> None:
    bits = fuzzer.rng.getrandbits(24)
    first = (0x90, 0x91, 0x92, 0x93, 1, 2, 4, 5)[bits & 7] if bits & 8 else bits >> 4 & 0xFF
    fuzzer.receive(bytes((first,)) + fuzzer.rng.randbytes((bits >> 12) % 121))


def decoder(fuzzer: Fuzzer) -> None:
    try:
        decode(fuzzer.frames())
    except DecodeError:
        return


def sealed_data(fuzzer: Fuzzer) -> None:
    """A key holder's frames to one boot, under short and long headers."""
    channel = fuzzer.insider.path.channel
    seal = channel.seal if fuzzer.rng.getrandbits(2) else channel.seal_long
    number, data = seal(fuzzer.frames())
    fuzzer.sent_packets.add(number, None)
    fuzzer.receive(data)


def sealed_to_all(fuzzer: Fuzzer) -> None:
    bits = fuzzer.rng.getrandbits(3)
    channel = fuzzer.pair.a._state.broadcast_channel if bits & 3 else fuzzer.stranger
    seal = channel.seal if bits & 4 else channel.seal_long
    fuzzer.receive(seal(fuzzer.frames())[1])


def mutated_datagrams(fuzzer: Fuzzer) -> None:
    """Sealed datagrams modified in transit: they cannot be opened."""
    number, data = fuzzer.insider.path.channel.seal(fuzzer.seed_datagram())
    fuzzer.sent_packets.add(number, None)
    fuzzer.receive(fuzzer.mutated(data))


def legacy(fuzzer: Fuzzer) -> None:
    data = fuzzer.mutated(fuzzer.rng.choice(fuzzer.legacy_seeds))
    fuzzer.pair.b.receive(data, "mesh", LEGACY_ADDRESS, fuzzer.pair.now)


def subscriptions(fuzzer: Fuzzer) -> None:
    """Messages of a key holder about what its programs read, while it is sent messages."""
    bits = fuzzer.rng.getrandbits(16)
    table = fuzzer.messages.tables[bits % len(fuzzer.messages.tables)]
    fuzzer.messages.receive_table(fuzzer.mutated(table) if bits & 0x7000 else table)


def versions(fuzzer: Fuzzer) -> None:
    """Versions of a key holder, and differences to those that arrived before."""
    bits = fuzzer.rng.getrandbits(24)
    body, flags = fuzzer.messages.versions[bits % len(fuzzer.messages.versions)]
    if bits & 0x3000:
        body = fuzzer.mutated(body)
    if not bits & 0x1C000:
        flags = bits >> 17 & (MessageFlag.COMPRESSED | MessageFlag.ZSTD)
    fuzzer.messages.receive_version(body, flags)


def thin_frames(fuzzer: Fuzzer) -> None:
    """Real frames of a thin link modified in transit, and random ones."""
    bits = fuzzer.rng.getrandbits(24)
    frames = fuzzer.thin.frames
    data = frames[bits % len(frames)][1] if bits & 3 else fuzzer.rng.randbytes(bits % 256)
    # The limit of forgeries would close the link to all that follow.
    fuzzer.thin.thin("b").links[RADIO.name].forgeries.failures = 0
    fuzzer.receive_thin(fuzzer.mutated(data))


def _thin_frame(fuzzer: Fuzzer) -> bytes:
    """A key holder's items in a short frame or an introduction."""
    sender = fuzzer.thin.thin("a")
    seeds, bits = fuzzer.thin_seeds, fuzzer.rng.getrandbits(24)
    items = b"".join(seeds[bits >> shift & 7] for shift in range(0, 3 * (bits >> 21), 3))
    if bits & 1 << 20:
        items = fuzzer.mutated(items)
    return sender._seal(ComposedFrame(items[:240], bool(bits & 1 << 19), False, ()), fuzzer.thin.now)


def sealed_thin(fuzzer: Fuzzer) -> None:
    """A key holder's items, in short frames and introductions."""
    fuzzer.receive_thin(_thin_frame(fuzzer))


def serial_lines(fuzzer: Fuzzer) -> None:
    """The bytes of a key holder's frames on a serial line or from an XBee, as they are, modified on their way, and
    noise; what the decoder finds in them reaches the node."""
    bits = fuzzer.rng.getrandbits(24)
    framing = bits % 3
    if bits >> 2 & 7:
        data = fuzzer.line.encode(framing, _thin_frame(fuzzer))
        data = fuzzer.mutated(data) if bits >> 5 & 3 else data
    else:
        data = fuzzer.rng.randbytes(bits >> 8 & 0xFF)
    fuzzer.thin.thin("b").links[RADIO.name].forgeries.failures = 0
    for frame in fuzzer.line.feed(framing, data):
        fuzzer.receive_thin(frame)


def hostile_frames(fuzzer: Fuzzer) -> None:
    """Frames of a key holder that are well-formed and say anything."""
    fuzzer.hostile.receive()


def relay_frames(fuzzer: Fuzzer) -> None:
    """A key holder's frames between relays, to one neighbor and to all."""
    seeds, bits = fuzzer.relay.seeds, fuzzer.rng.getrandbits(16)
    frame = seeds[bits % len(seeds)]
    fuzzer.relay.receive(fuzzer.mutated(frame) if bits & 0x7000 else frame, to_all=bool(bits & 1 << 15))


def log_messages(fuzzer: Fuzzer) -> None:
    """A key holder's messages about shared logs, and items."""
    logs, bits = fuzzer.logs, fuzzer.rng.getrandbits(16)
    seeds, receive = (logs.control, logs.receive_control) if bits & 0xC000 else (logs.items, logs.receive_item)
    data = seeds[bits % len(seeds)]
    receive(fuzzer.mutated(data) if bits & 0x3800 else data)


SURFACES = {
    surface.__name__: surface
    for surface in (
        random_bytes,
        decoder,
        sealed_data,
        sealed_to_all,
        hostile_frames,
        mutated_datagrams,
        legacy,
        subscriptions,
        thin_frames,
        sealed_thin,
        serial_lines,
        relay_frames,
        log_messages,
        versions,
    )
}


class Chunk(NamedTuple):
    """One surface under one seed."""

    surface: str
    seed: int
    inputs: int

    def run(self) -> None:
        """Raises whatever a node raised, with the chunk as a note."""
        fuzzer = Fuzzer(self.seed)
        try:
            fuzzer.run(SURFACES[self.surface], self.inputs)
            fuzzer.check_bounds()
        except Exception as error:
            error.add_note(f"surface {self.surface}, seed {self.seed}, input {fuzzer.inputs}")
            raise


def chunks(inputs: int, chunk_inputs: int = CHUNK_INPUTS, surfaces: Sequence[str] = ()) -> Iterator[Chunk]:
    """An equal part for each surface (empty: all); the seed is the number of the chunk."""
    seed, names = 0, surfaces or tuple(SURFACES)
    while inputs > 0:
        size = min(inputs, chunk_inputs)
        yield Chunk(names[seed % len(names)], seed, size)
        inputs -= size
        seed += 1


def finished(record: Path) -> list[Chunk]:
    if not record.exists():
        return []
    return [Chunk(**json.loads(line)) for line in record.read_text().splitlines()]


def run(planned: Iterable[Chunk], record: Path, part: tuple[int, int] = (1, 1)) -> int:
    """Run every chunk of this part that the record does not hold; returns the inputs it ran."""
    number, of = part
    done = set(finished(record))
    ran = 0
    for chunk in planned:
        if chunk.seed % of != number - 1 or chunk in done:
            continue
        chunk.run()
        with record.open("a") as file:
            file.write(json.dumps(chunk._asdict()) + "\n")
        ran += chunk.inputs
    return ran


def _part(text: str) -> tuple[int, int]:
    number, _, of = text.partition("/")
    if not (number.isdigit() and of.isdigit() and 1 <= int(number) <= int(of)):
        raise argparse.ArgumentTypeError(f"expected NUMBER/PARTS, as in 1/2, found {text!r}")
    return int(number), int(of)


def _surfaces(text: str) -> list[str]:
    names = text.split(",")
    if unknown := sorted(set(names) - set(SURFACES)):
        raise argparse.ArgumentTypeError(f"expected names of {', '.join(SURFACES)}, found {', '.join(unknown)}")
    return names


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.udp_mesh.core.fuzzing", description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000_000, help="inputs in all, including those recorded")
    parser.add_argument("--part", type=_part, default=(1, 1), metavar="NUMBER/PARTS", help="run only these chunks")
    parser.add_argument("--record", type=Path, default=RECORD, help="finished chunks, one per line")
    parser.add_argument("--surfaces", type=_surfaces, default=(), metavar="NAME,...", help="only these")
    parser.add_argument("--totals", type=Path, help="also update the inputs per surface in this file")
    arguments = parser.parse_args()
    arguments.record.parent.mkdir(parents=True, exist_ok=True)
    run(chunks(arguments.inputs, surfaces=arguments.surfaces), arguments.record, arguments.part)
    by_surface: Counter[str] = Counter()
    for chunk in finished(arguments.record):
        by_surface[chunk.surface] += chunk.inputs
    if arguments.totals is not None:
        rows = arguments.totals.read_text().splitlines() if arguments.totals.exists() else []
        counts = {row["surface"]: row["inputs"] for row in map(json.loads, rows)} | by_surface
        totals = [json.dumps({"surface": name, "inputs": counts[name]}) for name in SURFACES if name in counts]
        arguments.totals.write_text("\n".join(totals) + "\n")
    lines = [*by_surface.items(), ("in all", by_surface.total())]
    sys.stdout.writelines(f"{name:18} {count:>12,}\n" for name, count in lines)


if __name__ == "__main__":
    main()
