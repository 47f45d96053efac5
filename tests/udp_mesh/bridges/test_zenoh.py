"""Two robots with a Zenoh session, a bridge and a daemon each: what holds between the sessions."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
import zenoh

from tests.udp_mesh.bridges.ros_processes import free_tcp_port
from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons
from tests.udp_mesh.links.sockets import WAIT_S

pytestmark = pytest.mark.xdist_group("zenoh")

TYPE = "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = f"0/chatter/{TYPE}"
TOKEN = f"@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MP/%/%/talker/%chatter/{TYPE}/1:2:1,10:,:,:,,"
CDR_HELLO = bytes.fromhex("00010000") + struct.pack("<I", 6) + b"hello\0"


def settings(listen: int | None = None, connect: int | None = None) -> dict[str, str]:
    """A peer on the loopback that looks for nobody."""
    return {
        "mode": '"peer"',
        "scouting/multicast/enabled": "false",
        "scouting/gossip/enabled": "false",
        "listen/endpoints": json.dumps([] if listen is None else [f"tcp/127.0.0.1:{listen}"]),
        "connect/endpoints": json.dumps([] if connect is None else [f"tcp/127.0.0.1:{connect}"]),
    }


@dataclass
class Side:
    """One robot: its session, and everything its subscribers saw."""

    daemon: RunningDaemon
    port: int
    session: Any
    samples: list[Any] = field(default_factory=list)
    tokens: dict[str, bool] = field(default_factory=dict)
    bridge: subprocess.Popen[bytes] | None = None
    kept: list[Any] = field(default_factory=list)

    def start_bridge(self, mode: str = "peer") -> None:
        command = [sys.executable, "-m", "udp_mesh.bridges.zenoh_bridge", "--socket", str(self.daemon.socket)]
        for key, value in {**settings(connect=self.port), "mode": json.dumps(mode)}.items():
            command += ["--set", f"{key}={value}"]
        command += ["--route", "demo/**=map", "--ros2", "/chatter=status"]
        with (self.daemon.folder / f"{self.daemon.name}-zenoh.log").open("ab") as log:
            self.bridge = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)

    def stop_bridge(self) -> None:
        if self.bridge is not None:
            self.bridge.terminate()
            self.bridge.wait(WAIT_S)
            self.bridge = None

    def saw(self, payload: bytes) -> list[Any]:
        return [sample for sample in self.samples if bytes(sample.payload) == payload]

    def put_until_seen(self, other: Side, key: str, payload: bytes, **more: Any) -> Any:
        """Puts it until the other side has it: who subscribes is known only after a while."""

        def seen() -> Any:
            self.session.put(key, payload, **more)
            return next(iter(other.saw(payload)), None)

        return poll(seen, f"{key} on the other side")


def open_side(daemon: RunningDaemon) -> Side:
    port = free_tcp_port()
    config = zenoh.Config()
    for key, value in settings(listen=port).items():
        config.insert_json5(key, value)
    # A router, so that a client on its network hears the bridge.
    config.insert_json5("mode", '"router"')
    side = Side(daemon, port, zenoh.open(config))

    def token(sample: Any) -> None:
        side.tokens[str(sample.key_expr)] = sample.kind == zenoh.SampleKind.PUT

    side.kept.append(side.session.declare_subscriber("demo/**", side.samples.append))
    side.kept.append(side.session.declare_subscriber("0/**", side.samples.append))
    side.kept.append(side.session.liveliness().declare_subscriber("@ros2_lv/**", token, history=True))
    return side


@pytest.fixture(scope="module")
def team() -> Iterator[tuple[Side, Side]]:
    with two_daemons() as (alice, bob):
        sides = open_side(alice), open_side(bob)
        try:
            for side in sides:
                side.start_bridge()
            yield sides
        finally:
            for side in sides:
                side.stop_bridge()
                side.session.close()


def test_a_sample_arrives_with_key_encoding_attachment_and_quality_of_service(team: tuple[Side, Side]) -> None:
    alice, bob = team
    sample = alice.put_until_seen(
        bob,
        "demo/robot/pose",
        b'{"x": 1}',
        encoding="application/json;v=2",
        attachment=b"\0attached",
        priority=zenoh.Priority.REAL_TIME,
        congestion_control=zenoh.CongestionControl.BLOCK,
        express=True,
    )
    assert str(sample.key_expr) == "demo/robot/pose"
    assert str(sample.encoding) == "application/json;v=2"
    assert bytes(sample.attachment) == b"\0attached"
    assert sample.priority == zenoh.Priority.REAL_TIME
    assert sample.congestion_control == zenoh.CongestionControl.BLOCK
    assert sample.express


def test_both_directions_are_carried_and_a_deletion_is_one(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.put_until_seen(alice, "demo/back", b"from bob")

    def deleted() -> bool:
        bob.session.delete("demo/back")
        return any(
            sample.kind == zenoh.SampleKind.DELETE and str(sample.key_expr) == "demo/back" for sample in alice.samples
        )

    poll(deleted, "the deletion")


def test_what_came_from_the_mesh_is_not_sent_back(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.put_until_seen(bob, "demo/loop", b"settled")
    before = len(alice.saw(b"once"))
    alice.session.put("demo/loop", b"once")
    poll(lambda: bob.saw(b"once"), "once at bob")
    # A message bob's side sends afterwards has overtaken nothing: an echo would have come before it.
    bob.put_until_seen(alice, "demo/loop", b"marker")
    assert len(alice.saw(b"once")) - before == 1
    assert len(bob.saw(b"once")) == 1


def test_a_second_bridge_beside_the_first_sends_nothing_back(team: tuple[Side, Side]) -> None:
    alice, bob = team
    # The twin hears bob's network and serves alice's daemon: whatever it sends comes out at bob's once more.
    twin = Side(alice.daemon, bob.port, None)
    twin.start_bridge(mode="client")
    try:
        puts = 0

        def doubled() -> bool:
            nonlocal puts
            puts += 1
            bob.session.put("demo/twin", b"up")
            return len(bob.saw(b"up")) > puts

        poll(doubled, "the twin")
        alice.session.put("demo/twin", b"single")
        poll(lambda: bob.saw(b"single"), "single at bob")
        bob.session.put("demo/twin", b"after")
        # Its own, what the twin sent, and what the twin got of bob's bridge.
        poll(lambda: len(bob.saw(b"after")) == 3, "what bob said, by way of the twin")
        assert len(bob.saw(b"single")) == 1
        assert len(alice.saw(b"single")) == 1
    finally:
        twin.stop_bridge()


def test_a_ros_2_message_keeps_its_cdr_type_hash_and_attachment(team: tuple[Side, Side]) -> None:
    alice, bob = team
    attachment = struct.pack("<qqB16s", 7, 1_700_000_000_000_000_000, 16, bytes(range(16)))
    sample = alice.put_until_seen(bob, CHATTER, CDR_HELLO, attachment=attachment)
    assert str(sample.key_expr) == CHATTER
    assert bytes(sample.attachment) == attachment


def test_a_ros_2_publisher_is_in_the_other_graph_with_its_qos_for_as_long_as_it_lives(team: tuple[Side, Side]) -> None:
    alice, bob = team
    token = alice.session.liveliness().declare_token(TOKEN)
    poll(lambda: bob.tokens.get(TOKEN), "the publisher at bob")
    bob.stop_bridge()
    poll(lambda: bob.tokens.get(TOKEN) is False, "the publisher gone with the bridge")
    bob.start_bridge()
    poll(lambda: bob.tokens.get(TOKEN), "the publisher again")
    token.undeclare()
    poll(lambda: bob.tokens.get(TOKEN) is False, "the publisher gone")


def test_a_restarted_daemon_is_found_again(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.daemon.kill()
    alice.daemon.start()
    alice.put_until_seen(bob, "demo/again", b"after the restart")
    assert bob.bridge is not None
    assert bob.bridge.poll() is None
