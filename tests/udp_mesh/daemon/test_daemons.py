"""Two real daemons: messages, changes at run time, metrics, recording, and hostile local programs."""

import json
import os
import random
import select
import shutil
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import pytest

from tests.udp_mesh.daemon.processes import RunningDaemon, collect, outcomes, poll, two_daemons
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh.client import MeshClient, MeshError, Message, mesh_client
from udp_mesh.client.mesh_client import encode_frame
from udp_mesh.core.events import Event
from udp_mesh.core.settings import Limits
from udp_mesh.daemon.interface import CONDITIONS_TOPIC

Pair = tuple[RunningDaemon, RunningDaemon]

pytestmark = pytest.mark.xdist_group("udp_mesh_daemons")


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with two_daemons() as daemons:
        yield daemons


def test_messages_arrive_as_they_were_sent_and_their_outcome_is_reported(pair: Pair) -> None:
    alice, bob = pair
    big = bytes(range(256)) * 12_000
    with alice.client() as sender, bob.client() as receiver:
        receiver.subscribe("status", "map")
        numbers = [
            sender.publish("status", b"ready", to="bob", type="std_msgs/String", notify=True),
            sender.publish("map", big, to="bob", notify=True),
            sender.publish("status", b"", to="bob", notify=True),
        ]
        found = sorted(collect(receiver, 3), key=lambda message: len(message.payload))
        ends = outcomes(sender, 3)
    assert [message.payload for message in found] == [b"", b"ready", big]
    assert found[1] == Message("alice", "status", "std_msgs/String", b"ready", 0, False)
    assert ends == dict.fromkeys(numbers, "delivered")


RECORDED_KEYS = Path(__file__).with_name("json_keys.json")
"""Keys of every document, as paths (`peers[].name`), for scripts that read them: none may disappear."""


def key_paths(value: Any, prefix: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield f"{prefix}.{key}".lstrip(".")
            yield from key_paths(inner, f"{prefix}.{key}".lstrip("."))
    elif isinstance(value, list):
        for inner in value:
            yield from key_paths(inner, f"{prefix}[]")


def test_recorded_json_keys_are_still_present(pair: Pair) -> None:
    alice, _ = pair
    with alice.client() as client:
        client.request("ping", peer="bob", timeout_s=WAIT_S)
        seen = {op: set(key_paths(client.request(op))) for op in ("status", "peers", "topics", "neighbours")}
    seen |= {kind.__name__: {item.name for item in fields(kind)} for kind in get_args(Event)}
    recorded: dict[str, list[str]] = json.loads(RECORDED_KEYS.read_text(encoding="utf-8"))
    gone = {name: sorted(set(before) - seen[name]) for name, before in recorded.items()}
    assert {name: missing for name, missing in gone.items() if missing} == {}


def test_a_standalone_copy_of_the_client_module_sends_and_receives(pair: Pair, tmp_path: Path) -> None:
    alice, bob = pair
    shutil.copy(mesh_client.__file__, tmp_path / "mesh_client.py")
    script = f"""
from mesh_client import MeshClient
with MeshClient({str(bob.socket)!r}) as mesh:
    mesh.subscribe("status")
    print("subscribed", flush=True)
    for message in mesh.messages({WAIT_S}):
        mesh.publish("status", message.payload.upper(), to=message.source)
        break
"""
    program = subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, stdout=subprocess.PIPE, env={})
    with program, alice.client() as client:
        assert program.stdout is not None
        assert program.stdout.readline() == b"subscribed\n"
        client.subscribe("status")
        client.publish("status", b"echo this", to="bob")
        assert collect(client, 1)[0].payload == b"ECHO THIS"
        assert program.wait(WAIT_S) == 0


@pytest.mark.parametrize(
    ("op", "fields", "code"),
    [
        ("publish", {"topic": "unknown", "to": "bob"}, "unknown-topic"),
        ("publish", {"topic": "status", "to": "nobody"}, "unknown-peer"),
        ("publish", {"topic": "~mesh/ping", "to": "bob"}, "reserved-topic"),
        ("publish", {"topic": 5}, "bad-request"),
        ("publish", {"topic": "status", "to": "bob", "type": 5}, "bad-request"),
        ("subscribe", {"topics": "status"}, "bad-request"),
        ("dance", {}, "unknown-op"),
        ("set-topic", {"topic": "status", "values": {"priority": 99}}, "bad-configuration"),
        ("set-topic", {"topic": "status", "values": []}, "bad-request"),
        ("set-window", {"window": 0}, "bad-request"),
        ("set-rates", {"values": {"offline_s": "soon"}}, "bad-configuration"),
        ("set-neighbor", {"address": "base"}, "bad-request"),
        ("set-neighbour", {"address": "127.0.3.9", "legacy": True}, "bad-request"),
        ("drop-neighbor", {"address": "127.0.3.9"}, "unknown-neighbour"),
        ("drop-neighbour", {"address": "127.0.3.9"}, "unknown-neighbour"),
        ("drop-topic", {"topic": "unknown"}, "unknown-topic"),
        ("set-keys", {"file": "/nowhere/fleet.key"}, "bad-configuration"),
        ("record-stop", {}, "not-recording"),
        ("record-start", {"path": "/nowhere/run.jsonl"}, "cannot-record"),
        ("ping", {"peer": "nobody"}, "unknown-peer"),
        ("ping", {"peer": "bob", "timeout_s": -1}, "bad-request"),
        ("set-keys", {"file": "fleet\0.key"}, "bad-request"),
        ("record-start", {"path": "run\0.jsonl"}, "bad-request"),
    ],
)
def test_an_invalid_request_is_rejected_with_a_code_and_a_reason(
    pair: Pair, op: str, fields: dict[str, Any], code: str
) -> None:
    with pair[0].client() as client:
        with pytest.raises(MeshError) as caught:
            client.request(op, **fields)
        assert caught.value.code == code
        assert str(caught.value)
        client.request("peers")


@pytest.mark.parametrize(
    "raw", [b"\xff" * 100, encode_frame({})[:-1] + b"x", b"GET / HTTP/1.1\r\n\r\n", encode_frame({"op": "publish"}) * 3]
)
def test_a_client_that_sends_garbage_does_not_disturb_others(pair: Pair, raw: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as hostile:
        hostile.connect(str(pair[0].socket))
        hostile.sendall(raw)
        hostile.shutdown(socket.SHUT_WR)
        hostile.settimeout(WAIT_S)
        while hostile.recv(1000):
            continue
    with pair[0].client() as client:
        client.request("peers")


def test_a_message_above_the_limit_is_refused_and_the_connection_continues(pair: Pair) -> None:
    alice, bob = pair
    limit = Limits().message_bytes
    with alice.client() as sender, bob.client() as receiver:
        receiver.subscribe("map")
        with pytest.raises(MeshError) as caught:
            sender.publish("map", bytes(limit + 1), to="bob")
        assert caught.value.code == "too-large"
        sender.publish("map", bytes(limit + 1), to="bob", wait=False)
        frame = sender.next_frame(WAIT_S)
        assert frame is not None
        assert (frame[0]["event"], frame[0]["code"]) == ("rejected", "too-large")
        sender.publish("map", b"fits", to="bob")
        assert collect(receiver, 1)[0].payload == b"fits"


def test_a_client_that_does_not_read_replies_is_throttled(pair: Pair) -> None:
    # Replies contain the id: a long id makes long replies.
    request, taken = encode_frame({"op": "neighbours", "id": "x" * 60_000}), 0
    with socket.socket(socket.AF_UNIX) as hostile:
        hostile.connect(str(pair[0].socket))
        hostile.setblocking(False)
        before, rest = resident_bytes(pair[0]), request
        while poll_writable(hostile):
            sent = hostile.send(rest)
            taken += sent
            rest = rest[sent:] or request
            assert taken < 200 << 20, "it is answered without end"
        assert taken > 32 << 20
        assert resident_bytes(pair[0]) < before + (100 << 20)
        with pair[0].client() as client:
            client.request("peers")
        hostile.setblocking(True)
        while taken > 0:
            taken -= len(hostile.recv(1 << 20))


def resident_bytes(daemon: RunningDaemon) -> int:
    assert daemon.process is not None
    return int(Path(f"/proc/{daemon.process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def poll_writable(program: socket.socket) -> bool:
    """Whether the daemon reads more from this client within a second."""
    return bool(select.select([], [program], [], 1.0)[1])


def test_a_slow_subscriber_loses_messages_and_gets_the_count(pair: Pair) -> None:
    alice, bob = pair
    payload = bytes(1_000_000)
    with alice.client() as sender, bob.client() as lazy:
        lazy.subscribe("map")
        # on a busy computer the peer may be lost meanwhile
        delivered = 0
        for _ in range(3):
            for _ in range(20):
                sender.publish("map", payload, to="bob", notify=True)
            delivered += list(outcomes(sender, 20).values()).count("delivered")
        received = dropped = 0
        while received + dropped < delivered:
            frame = lazy.next_frame(WAIT_S)
            assert frame is not None
            received += frame[0]["event"] == "message"
            dropped += frame[0].get("messages", 0)
        assert dropped > 0
        assert received >= 32


def test_topics_are_added_changed_and_dropped_while_messages_flow(pair: Pair) -> None:
    alice, bob = pair
    with alice.client() as sender, bob.client() as receiver:
        receiver.subscribe("map", "extra")
        numbers = [sender.publish("map", bytes([n]) * 50_000, to="bob", notify=True) for n in range(10)]
        assert sender.request("set-topic", topic="extra", values={"priority": 1})["changes"]
        numbers.append(sender.publish("extra", b"new", to="bob", notify=True))
        assert sender.request("set-topic", topic="map", values={"priority": 2})["changes"]
        sender.request("set-window", window=3)
        sender.request("set-rates", values={"ack_delay_s": 0.005})
        sender.request("drop-topic", topic="extra")
        sender.request("set-window", window="adaptive")
        assert set(outcomes(sender, 11).values()) == {"delivered"}
        assert len(collect(receiver, 11)) == 11
        with pytest.raises(MeshError, match="unknown topic"):
            sender.publish("extra", b"gone", to="bob")
        names = {topic["name"]: topic for topic in sender.request("topics")["topics"]}
        assert names["map"]["priority"] == 2
        assert not names["extra"]["configured"]
        sender.request("reload")
        names = {topic["name"]: topic for topic in sender.request("topics")["topics"]}
        assert names["map"]["priority"] == 7


def test_local_programs_can_subscribe_to_conditions(pair: Pair) -> None:
    with pair[0].client() as client:
        client.subscribe(CONDITIONS_TOPIC)
        frame = client.next_frame(WAIT_S)
        assert frame is not None
        assert frame[0]["event"] == "conditions"
        assert [peer["name"] for peer in frame[0]["conditions"]["peers"]] == ["bob"]


def test_status_shows_links_keys_and_peers_and_never_a_secret(pair: Pair) -> None:
    with pair[0].client() as client:
        status = client.request("status")
    assert status["links"][0]["address"].startswith("127.0.3.1:")
    assert not status["unkeyed"]
    assert status["conditions"]["peers"][0]["online"]
    assert "00112233" not in json.dumps(status)


def test_a_ping_goes_through_both_daemons(pair: Pair) -> None:
    with pair[0].client() as client:
        assert 0 < client.request("ping", peer="bob", timeout_s=WAIT_S)["round_trip_s"] < WAIT_S


def test_a_recording_holds_what_was_sent_received_and_measured(pair: Pair, tmp_path: Path) -> None:
    alice, bob = pair
    sent_file, received_file = tmp_path / "alice.jsonl", tmp_path / "bob.jsonl"
    with alice.client() as sender, bob.client() as receiver:
        receiver.subscribe("status")
        sender.request("record-start", path=str(sent_file))
        receiver.request("record-start", path=str(received_file), payloads=True)
        with pytest.raises(MeshError, match="already recording"):
            sender.request("record-start", path=str(tmp_path / "second.jsonl"))
        number = sender.publish("status", b"recorded", to="bob", notify=True)
        outcomes(sender, 1)
        collect(receiver, 1)
        assert sender.request("record-stop")["lines"] >= 4
        receiver.request("record-stop")
    sent = [json.loads(line) for line in sent_file.read_text().splitlines()]
    received = [json.loads(line) for line in received_file.read_text().splitlines()]
    assert sent[0]["recording"] == 1
    assert sent[0]["node"] == "alice"
    assert any(line.get("kind") == "sent" and line["message"] == number and line["bytes"] == 8 for line in sent)
    assert any(line.get("kind") == "message-delivered" and line["message_id"] == number for line in sent)
    arrived = next(line for line in received if line.get("kind") == "received")
    assert (arrived["source"], arrived["topic"], arrived["priority"]) == ("alice", "status", 0)
    assert arrived["payload"] == "cmVjb3JkZWQ="
    assert [line["t"] for line in received[1:]] == sorted(line["t"] for line in received[1:])
    assert sum(line.get("kind") == "conditions" for line in sent) >= 2


def test_prometheus_reads_metrics_over_tcp_and_over_the_local_socket() -> None:
    port = free_port()
    with two_daemons(alice_more=f'metrics_address = "127.0.0.1:{port}"') as (alice, _):
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=WAIT_S) as answer:
            page = answer.read().decode()
        with alice.client() as client:
            _, local = client.request_frame("metrics")
    for text in (page, local.decode()):
        assert 'udp_mesh_peer_online{peer="bob"} 1' in text
        assert "# TYPE udp_mesh_datagrams_sent_total counter" in text


def test_garbage_on_the_udp_port_stops_neither_the_daemon_nor_urgent_messages(pair: Pair) -> None:
    alice, bob = pair
    source = random.Random(11)
    with (
        bob.client() as receiver,
        alice.client() as sender,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as attacker,
    ):
        receiver.subscribe("status")
        host, port = receiver.request("status")["links"][0]["address"].split(":")
        before = receiver.request("status")["conditions"]["counters"]
        for turn in range(3000):
            # Noise, and headers in the current and the legacy format in front of noise.
            first = bytes((source.choice((0x90, 0x91, 0x92, 0x93, 0xA0, 1, 2, 4, 5, source.randrange(256))),))
            attacker.sendto(first + source.randbytes(source.randrange(200)), (host, int(port)))
            if turn % 300 == 0:
                sender.publish("status", b"%d" % turn, to="bob", notify=True)
        assert set(outcomes(sender, 10).values()) == {"delivered"}
        assert len(collect(receiver, 10)) == 10
        after = receiver.request("status")["conditions"]["counters"]
    dropped = ("dropped_malformed", "dropped_unauthenticated", "dropped_unproven", "dropped_over_limit")
    # The kernel drops what the queue for strangers cannot hold; the smallest one holds a hundred.
    assert sum(after[name] - before[name] for name in dropped) > 100
    assert "Traceback" not in bob.log.read_text()


def test_an_idle_client_does_not_hold_up_the_others(pair: Pair) -> None:
    alice, _ = pair
    idle = [MeshClient(str(alice.socket)) for _ in range(20)]
    try:
        with alice.client() as client:
            poll(lambda: client.request("peers")["peers"] != [], "an answer")
    finally:
        for client in idle:
            client.close()
