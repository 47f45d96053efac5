"""An independent implementation, written from docs/wire-format.md alone, interoperates with a real daemon."""

import json
import os
import random
import socket
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from tests.udp_mesh.daemon.processes import KEY, OTHER_KEY, RunningDaemon, collect, configuration, outcomes, wait_online
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from tests.udp_mesh.wire.foreign_format import (
    COMPACT,
    COMPRESSED,
    CONFIRM,
    CONFIRMS,
    FLAG_TO_ALL,
    FLAG_ZSTD,
    NUMBERED,
    RELIABLE,
    TIMED,
    VERSION,
    VERSIONS,
    ZLIB,
    ZSTD,
    Channel,
    FleetKey,
    Parser,
    difference,
    fragment,
    read_number,
    read_version,
    version_hash,
)
from tests.udp_mesh.wire.foreign_peer import ForeignNode
from tests.udp_mesh.wire.make_vectors import FOLDER
from udp_mesh.client import MeshClient

pytestmark = pytest.mark.xdist_group("udp_mesh_daemons")

TOPICS = """
packed = { priority = 6, compression = true }
cast = { priority = 4, repair = true }
stored = { priority = 5, outbox = "all", outbox_on_disk = true }
soon = { priority = 5, deadline_s = 30.0 }
grid = { priority = 7, delta = true }
"""
LATER_FEATURES = 0xFFFFFFFF << 11 & 0xFFFFFFFF
"""Bits that have no meaning yet; with these, the heartbeats have unknown fields too."""
ZSTD_MAGIC, ZLIB_MAGIC = "28b52ffd", "78"


@pytest.fixture(scope="module")
def daemon() -> Iterator[RunningDaemon]:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder = Path(path)
        with RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [7], free_port(), topics=TOPICS)) as one:
            yield one


EVERYTHING = ZLIB | TIMED | CONFIRMS | COMPACT | ZSTD | VERSIONS


@pytest.fixture(params=[0, ZLIB, ZLIB | ZSTD | VERSIONS, ZLIB | ZSTD | VERSIONS | LATER_FEATURES, EVERYTHING])
def foreign(daemon: RunningDaemon, request: pytest.FixtureRequest) -> Iterator[ForeignNode]:
    """One that the daemon has met; it goes with a good-bye."""
    with daemon.client() as client:
        host, port = client.request("status")["links"][0]["address"].split(":")
    with socket.socket(type=socket.SOCK_DGRAM) as own:
        own.bind(("127.0.3.7", int(port)))
        name = f"foreign{request.param}-{os.urandom(4).hex()}"
        node = ForeignNode(bytes.fromhex(KEY), name, own, (host, int(port)), request.param)
        if request.param & LATER_FEATURES:
            node.new_fields = b"of a later version" * 10
        assert node.run(lambda: node.peer("alice"), WAIT_S)
        with daemon.client() as client:
            assert node.run(lambda: node.name in online(client), WAIT_S)
        yield node
        node.bye()
        wait_online(daemon, node.name, online=False)


def online(client: MeshClient) -> list[str]:
    return [peer["name"] for peer in client.request("peers")["peers"] if peer["online"]]


def test_an_independent_implementation_matches_the_published_vectors() -> None:
    kinds = ("hello", "broadcast", "introduction", "data")
    for vector in json.loads((FOLDER / "sealed.json").read_text()):
        boots = [bytes.fromhex(vector[name] or "00" * 16) for name in ("sender_boot", "receiver_boot")]
        channel = Channel(FleetKey(bytes.fromhex(vector["fleet_key"])), *boots)
        sealed = channel.seal(kinds.index(vector["title"]), bytes.fromhex(vector["frames"]), vector["packet_number"])
        assert sealed.hex() == vector["datagram"]
    for vector in json.loads((FOLDER / "frames.json").read_text()).values():
        assert len(Parser(bytes.fromhex(vector["hex"])).frames()) == len(vector["frames"])
    for vector in json.loads((FOLDER / "newer.json").read_text()).values():
        (_, heartbeat), *others = Parser(bytes.fromhex(vector["hex"])).frames()
        assert heartbeat["features"] == vector["frames"][0]["features"]
        assert [tag.hex() for tag in heartbeat["heard"]] == vector["frames"][0]["heard"]
        assert len(others) == len(vector["frames"]) - 1
    for vector in json.loads((FOLDER / "thin.json").read_text())["numbered"].values():
        ((_, fragment),) = Parser(bytes.fromhex(vector["hex"])).frames()
        assert fragment["head"]["flags"] == RELIABLE | NUMBERED
        assert read_number(fragment["payload"]) == (vector["number"], bytes.fromhex(vector["payload"]))
    versions = json.loads((FOLDER / "versions.json").read_text())
    for vector in versions["accepted"].values():
        held = {version_hash(base)[:4]: base for base in [bytes.fromhex(vector["base"] or "")] if base}
        assert read_version(bytes.fromhex(vector["body"]), vector["flags"], held).hex() == vector["payload"]


def test_a_foreign_node_receives_and_acknowledges_messages_of_any_size(
    daemon: RunningDaemon, foreign: ForeignNode
) -> None:
    noise = random.Random(1).randbytes(60_000)
    payloads = {"status": b"", "map": noise, "packed": b"again and " * 3000}
    with daemon.client() as client:
        for topic, payload in payloads.items():
            client.publish(topic, payload, to=foreign.name, type="a/Type", notify=True)
        assert foreign.run(lambda: len(foreign.arrived) == len(payloads), WAIT_S)
        foreign.run(lambda: False, 0.1)
        assert set(outcomes(client, len(payloads)).values()) == {"delivered"}
    assert {one.topic: one.payload for one in foreign.arrived} == payloads
    assert {one.type_name for one in foreign.arrived} == {"a/Type"}
    # Compression is used only with peers that announce it, and zstd rather than zlib.
    packed = next(one for one in foreign.arrived if one.topic == "packed")
    assert bool(packed.flags & COMPRESSED) == bool(foreign.features & ZLIB)
    assert bool(packed.flags & FLAG_ZSTD) == bool(foreign.features & ZSTD)
    if packed.flags & COMPRESSED:
        assert packed.body.hex().startswith(ZSTD_MAGIC if foreign.features & ZSTD else ZLIB_MAGIC)


def has_arrived(foreign: ForeignNode, count: int) -> bool:
    return len(foreign.arrived) == count


def add_ends(ends: list[str], client: MeshClient) -> bool:
    """Add an outcome, if one is here. Whether there is any."""
    frame = client.next_frame(0.0)
    if frame is not None and frame[0].get("event") == "outcome":
        ends.append(str(frame[0]["outcome"]))
    return bool(ends)


def grids(count: int) -> list[bytes]:
    """Random cells, of which each version changes some."""
    rng = random.Random(4)
    cells = bytearray(rng.randbytes(6000))
    made = []
    for _ in range(count):
        at = rng.randrange(5000)
        cells[at : at + 8] = rng.randbytes(8)
        cells += rng.randbytes(20)
        made.append(bytes(cells))
    return made


def test_a_foreign_node_receives_versions_as_differences_if_it_announces_that(
    daemon: RunningDaemon, foreign: ForeignNode
) -> None:
    sent = grids(3)
    with daemon.client() as client:
        for number, payload in enumerate(sent, 1):
            client.publish("grid", payload, to=foreign.name, notify=True)
            assert foreign.run(partial(has_arrived, foreign, number), WAIT_S)
            # The next one refers to this one only if it is known to have arrived.
            foreign.run(lambda: False, 0.1)
            assert set(outcomes(client, 1).values()) == {"delivered"}
    assert [one.payload for one in foreign.arrived] == sent
    if not foreign.features & VERSIONS:
        assert not any(one.flags & VERSION for one in foreign.arrived)
        return
    assert all(one.flags & VERSION for one in foreign.arrived)
    bases = [bytes(4), *(version_hash(payload)[:4] for payload in sent)]
    assert [one.body[:4] for one in foreign.arrived] == bases[:3]
    for one in foreign.arrived[1:]:
        assert one.body[12:].hex().startswith(ZSTD_MAGIC)
        assert len(one.body) < 200


def test_versions_from_a_foreign_node_are_decoded_and_those_without_a_base_refused(
    daemon: RunningDaemon, foreign: ForeignNode
) -> None:
    alice = foreign.peer("alice")
    assert alice is not None
    first, second, third, _ = grids(4)
    packed = RELIABLE | COMPRESSED | FLAG_ZSTD | VERSION
    with daemon.client() as client:
        client.subscribe("grid")
        for body, flags, end in (
            (bytes(4) + version_hash(first) + first, RELIABLE | VERSION, "delivered"),
            (difference(second, first), packed, "delivered"),
            (difference(third, b"never sent" * 5), packed, "refused 4"),
            (difference(third, first), packed, "delivered"),
        ):
            number = foreign.send(alice, "grid", body, flags=flags)
            assert foreign.run(partial(alice.ends.get, number), WAIT_S)
            assert alice.ends[number] == end
        assert [message.payload for message in collect(client, 3)] == [first, second, third]


def test_messages_from_a_foreign_node_arrive_once_and_are_acknowledged(
    daemon: RunningDaemon, foreign: ForeignNode
) -> None:
    alice = foreign.peer("alice")
    assert alice is not None
    payloads = [b"", b"x", random.Random(2).randbytes(50_000)]
    with daemon.client() as client:
        client.subscribe("*")
        numbers = [foreign.send(alice, "from-abroad", payload, size=700) for payload in payloads]
        assert foreign.run(lambda: all(number in alice.ends for number in numbers), WAIT_S)
        assert {alice.ends[number] for number in numbers} == {"delivered"}
        found = collect(client, len(payloads))
        assert sorted(message.payload for message in found) == sorted(payloads)
        assert {(message.source, message.topic, message.type) for message in found} == {
            (foreign.name, "from-abroad", "foreign/Type")
        }
        # Complete messages sent again are acknowledged again but not delivered twice.
        for number in numbers:
            alice.ends.pop(number)
        alice.next_id = 0
        for payload in payloads:
            foreign.send(alice, "from-abroad", payload, size=700)
        assert foreign.run(lambda: all(number in alice.ends for number in numbers), WAIT_S)
        foreign.send(alice, "from-abroad", b"last")
        foreign.run(lambda: not alice.in_flight, WAIT_S)
        assert collect(client, 1)[0].payload == b"last"


def test_numbered_messages_from_a_foreign_node_arrive_without_their_number_and_copies_once(
    daemon: RunningDaemon, foreign: ForeignNode
) -> None:
    alice = foreign.peer("alice")
    assert alice is not None
    bodies = [b"\x12\x34stop", b"\x12\x34stop", b"\x12\x35", b"\x12\x36go"]
    with daemon.client() as client:
        client.subscribe("*")
        numbers = [foreign.send(alice, "estop", body, flags=RELIABLE | NUMBERED) for body in bodies]
        assert foreign.run(lambda: all(number in alice.ends for number in numbers), WAIT_S)
        assert {alice.ends[number] for number in numbers} == {"delivered"}
        assert sorted(message.payload for message in collect(client, 3)) == [b"", b"go", b"stop"]
        too_short = foreign.send(alice, "estop", b"\x12", flags=RELIABLE | NUMBERED)
        assert foreign.run(partial(alice.ends.get, too_short), WAIT_S)
        assert alice.ends[too_short] == "refused 3"
        assert list(client.messages(0.1)) == []


def test_broadcasts_work_in_both_directions(daemon: RunningDaemon, foreign: ForeignNode) -> None:
    with daemon.client() as client:
        client.subscribe("*")
        foreign.broadcast("shout", b"hear me")
        foreign.run(lambda: False, 0.05)
        (message,) = collect(client, 1)
        assert (message.topic, message.payload, message.broadcast) == ("shout", b"hear me", True)
        client.publish("cast", b"short")
        assert foreign.run(lambda: len(foreign.arrived) == 1, WAIT_S)
        client.publish("cast", bytes(5000))
        assert foreign.run(lambda: len(foreign.arrived) == 2, WAIT_S)
        assert [one.payload for one in foreign.arrived] == [b"short", bytes(5000)]
    assert all(one.flags & FLAG_TO_ALL for one in foreign.arrived)


def test_a_daemon_requests_lost_broadcasts_of_a_foreign_node(daemon: RunningDaemon, foreign: ForeignNode) -> None:
    with daemon.client() as client:
        client.subscribe("*")
        for payload, lost in ((b"first", False), (b"second", True), (b"gone", True), (b"fourth", False)):
            foreign.broadcast("shout", payload, repair=True, lost=lost)
        # No longer kept: the answer is a CANCEL.
        del foreign.repairable[2]
        assert foreign.run(lambda: foreign.requested == {1, 2}, WAIT_S)
        assert sorted(message.payload for message in collect(client, 3)) == [b"first", b"fourth", b"second"]


def test_a_message_is_delivered_once_a_foreign_node_that_confirms_has_confirmed_it(
    daemon: RunningDaemon, foreign: ForeignNode
) -> None:
    foreign.confirms = False
    with daemon.client() as client:
        client.publish("stored", b"keep this", to=foreign.name, notify=True)
        assert foreign.run(lambda: len(foreign.arrived) == 1, WAIT_S)
        assert bool(foreign.arrived[0].flags & CONFIRM) == bool(foreign.features & CONFIRMS)
        if foreign.features & CONFIRMS:
            foreign.run(lambda: False, 0.2)
            assert client.next_frame(0.0) is None
            # The daemon sends the head again because the confirmation is overdue.
            foreign.confirms = True
        ends: list[str] = []
        assert foreign.run(partial(add_ends, ends, client), WAIT_S)
        assert ends == ["delivered"]


def test_a_message_has_the_lifetime_that_a_foreign_node_states(daemon: RunningDaemon, foreign: ForeignNode) -> None:
    alice = foreign.peer("alice")
    assert alice is not None
    with daemon.client() as client:
        for number in (1, 2):
            client.publish("soon", b"in time", to=foreign.name, notify=True)
            assert foreign.run(partial(has_arrived, foreign, number), WAIT_S)
            foreign.run(lambda: False, 0.1)
            assert set(outcomes(client, 1).values()) == {"delivered"}
        # The first one came in an introduction, which has no lifetimes.
        life_ms = foreign.arrived[1].head.get("life")
        if not foreign.features & TIMED:
            assert life_ms is None
            return
        assert life_ms is not None
        assert 0 < life_ms <= 30_000
        client.subscribe("*")
        parts = bytes(1000), b"the rest"
        late = foreign.send(alice, "from-abroad", b"".join(parts), life_ms=200, leave_out=1)
        foreign.run(lambda: False, 0.4)
        alice.in_flight[late] = [(fragment(late, 1, parts[1], None), set())]
        kept = foreign.send(alice, "from-abroad", b"soon enough", life_ms=30_000)
        assert foreign.run(lambda: kept in alice.ends, WAIT_S)
        foreign.run(lambda: False, 1.0)
        assert [message.payload for message in collect(client, 1)] == [b"soon enough"]
        # An acknowledgment would mean that it was delivered.
        assert late in alice.in_flight


def test_keys_are_rotated_without_interruption(daemon: RunningDaemon, foreign: ForeignNode) -> None:
    alice = foreign.peer("alice")
    assert alice is not None
    key_file = daemon.folder / "alice.key"
    old, new = bytes.fromhex(KEY), bytes.fromhex(OTHER_KEY)
    steps = [([KEY, OTHER_KEY], (old,)), ([KEY, OTHER_KEY], (new, old)), ([OTHER_KEY, KEY], (new, old))]
    steps += [([OTHER_KEY, KEY], (new,)), ([OTHER_KEY], (new,))]
    with daemon.client() as client:
        client.subscribe("*")
        for number, (keys, secrets) in enumerate([*steps, *reversed(steps), ([KEY], (old,))]):
            key_file.write_text("\n".join(keys) + "\n")
            client.request("reload")
            foreign.set_keys(*secrets)
            sent = foreign.send(alice, "from-abroad", b"%d" % number)
            assert foreign.run(partial(alice.ends.get, sent), WAIT_S), number
            client.publish("status", b"%d" % number, to=foreign.name)
            assert foreign.run(partial(has_arrived, foreign, number + 1), WAIT_S), number
        assert [message.payload for message in collect(client, number + 1)] == [
            b"%d" % one for one in range(number + 1)
        ]
    assert foreign.peers[alice.boot] is alice
