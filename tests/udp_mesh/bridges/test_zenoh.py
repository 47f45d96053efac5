"""Two robots with a Zenoh session, a bridge and a daemon each."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
import zenoh
import zenoh.ext

from tests.udp_mesh.bridges.ros1_processes import free_tcp_port
from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons, wait_online
from tests.udp_mesh.links.sockets import WAIT_S

pytestmark = pytest.mark.xdist_group("zenoh")

TYPE = "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = f"0/chatter/{TYPE}"
TOKEN = f"@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MP/%/%/talker/%chatter/{TYPE}/1:2:1,10:,:,:,,"
KEPT_TYPE = "tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
KEPT = f"0/tf_static/{KEPT_TYPE}"
KEPT_TOKEN = f"@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/11/MP/%/%/frames/%tf_static/{KEPT_TYPE}/:1:,2:,:,:,,"
ROS2_CLIENT = """
import sys, time
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber, get_topic_info
about = dict(msg_type="std_msgs/msg/String", msg_definition="string data\\n", domain_id=0, router_port=int(sys.argv[2]))
if sys.argv[1] == "talk":
    publisher = ROS2Publisher("/chatter", **about)
    while True:
        publisher.publish(data="from an rmw_zenoh client")
        time.sleep(0.1)
subscriber = ROS2Subscriber("/chatter", callback=lambda message: print("heard", message.data, flush=True), **about)
while True:
    topic = get_topic_info("/chatter", router_port=about["router_port"])
    print("publishers", topic and topic.publisher_count, flush=True)
    time.sleep(0.2)
"""
"""Zenoh with the keys, attachments and tokens of rmw_zenoh, by others (zenoh-ros2-sdk). One session per process."""
CDR_HELLO = bytes.fromhex("00010000") + struct.pack("<I", 6) + b"hello\0"


def settings(listen: int | None = None, connect: int | None = None) -> dict[str, str]:
    """A peer on the loopback without scouting."""
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

    def start_bridge(self, mode: str = "peer", more: tuple[str, ...] = ()) -> None:
        command = [sys.executable, "-m", "udp_mesh.bridges.zenoh_bridge", "--socket", str(self.daemon.socket)]
        for key, value in {**settings(connect=self.port), "mode": json.dumps(mode)}.items():
            command += ["--set", f"{key}={value}"]
        command += ["--route", "demo/**=map", "--ros2", "/chatter=status", "--ros2", "/tf_static=map", *more]
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
        """Puts it repeatedly until the other side receives it, since discovery takes a while."""

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


def test_samples_and_deletions_are_also_relayed_in_the_reverse_direction(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.put_until_seen(alice, "demo/back", b"from bob")

    def deleted() -> bool:
        bob.session.delete("demo/back")
        return any(
            sample.kind == zenoh.SampleKind.DELETE and str(sample.key_expr) == "demo/back" for sample in alice.samples
        )

    poll(deleted, "the deletion")


def test_samples_from_the_mesh_are_not_sent_back(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.put_until_seen(bob, "demo/loop", b"settled")
    before = len(alice.saw(b"once"))
    alice.session.put("demo/loop", b"once")
    poll(lambda: bool(bob.saw(b"once")), "once at bob")
    # A message bob's side sends afterwards has overtaken nothing: an echo would have come before it.
    bob.put_until_seen(alice, "demo/loop", b"marker")
    assert len(alice.saw(b"once")) - before == 1
    assert len(bob.saw(b"once")) == 1


def test_a_second_bridge_on_the_same_network_does_not_echo_samples(team: tuple[Side, Side]) -> None:
    alice, bob = team
    # The twin is on bob's network and uses alice's daemon: whatever it sends would reach bob again.
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
        poll(lambda: bool(bob.saw(b"single")), "single at bob")
        bob.session.put("demo/twin", b"after")
        # Its own sample, the twin's, and the one the twin got from bob's bridge.
        poll(lambda: len(bob.saw(b"after")) == 3, "what bob said, by way of the twin")
        assert len(bob.saw(b"single")) == 1
        assert len(alice.saw(b"single")) == 1
    finally:
        twin.stop_bridge()


def test_a_ros_2_message_keeps_its_key_payload_and_attachment(team: tuple[Side, Side]) -> None:
    alice, bob = team
    attached = attachment(7, bytes(range(16)))
    sample = alice.put_until_seen(bob, CHATTER, CDR_HELLO, attachment=attached)
    assert str(sample.key_expr) == CHATTER
    assert bytes(sample.attachment) == attached


def test_a_ros_2_publisher_is_visible_in_the_remote_graph_while_it_exists(team: tuple[Side, Side]) -> None:
    alice, bob = team
    token = alice.session.liveliness().declare_token(TOKEN)
    poll(lambda: bob.tokens.get(TOKEN), "the publisher at bob")
    bob.stop_bridge()
    poll(lambda: bob.tokens.get(TOKEN) is False, "the publisher gone with the bridge")
    bob.start_bridge()
    poll(lambda: bob.tokens.get(TOKEN), "the publisher again")
    token.undeclare()
    poll(lambda: bob.tokens.get(TOKEN) is False, "the publisher gone")


def attachment(number: int, publisher: bytes) -> bytes:
    """An attachment of rmw_zenoh: sequence number, time, publisher."""
    return struct.pack("<qqB16s", number, 1_700_000_000_000_000_000 + number, 16, publisher)


def keeping(session: Any, depth: int) -> Any:
    """A transient local publisher as rmw_zenoh makes one."""
    numbered = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
    cache = zenoh.ext.CacheConfig(depth)
    return zenoh.ext.declare_advanced_publisher(
        session, KEPT, cache=cache, publisher_detection=True, sample_miss_detection=numbered
    )


def late_subscriber(side: Side, seen: list[bytes]) -> Any:
    """A transient local subscriber as rmw_zenoh makes one."""
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
    return zenoh.ext.declare_advanced_subscriber(
        side.session, KEPT, lambda sample: seen.append(bytes(sample.payload)), history=history
    )


def test_an_independent_rmw_zenoh_client_hears_another_robots_and_sees_its_publisher(team: tuple[Side, Side]) -> None:
    alice, bob = team
    log = bob.daemon.folder / "client.log"
    programs = []
    # as peers, they would have to reach the bridges without the router
    environment = {**os.environ, "ZENOH_CONFIG_OVERRIDE": 'mode="client"'}
    try:
        with log.open("wb") as out:
            for role, side in (("listen", bob), ("talk", alice)):
                command = [sys.executable, "-c", ROS2_CLIENT, role, str(side.port)]
                programs.append(subprocess.Popen(command, env=environment, stdout=out, stderr=subprocess.STDOUT))

        def heard() -> bool:
            lines = log.read_text().splitlines()
            return "heard from an rmw_zenoh client" in lines and "publishers 1" in lines

        poll(heard, "the message and the publisher")
    finally:
        for program in programs:
            program.terminate()
            program.wait(WAIT_S)
    assert "publishers 2" not in log.read_text()


def test_late_subscribers_and_robots_receive_cached_transient_local_samples(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.stop_bridge()
    token = alice.session.liveliness().declare_token(KEPT_TOKEN)
    publishers = [keeping(alice.session, 2), keeping(alice.session, 2)]
    for place, publisher in enumerate(publishers):
        for number in range(4):
            publisher.put(b"%d %d" % (place, number), attachment=attachment(number, bytes([place] * 16)))
    present: list[bytes] = []
    kept = [late_subscriber(bob, present)]
    # A robot that joins late gets the cached samples, the last two of each publisher.
    bob.start_bridge()
    poll(lambda: sorted(present) == [b"0 2", b"0 3", b"1 2", b"1 3"], f"what was kept: {present}")
    # A late subscriber on the robot that received it from the mesh.
    late: list[bytes] = []
    kept.append(late_subscriber(bob, late))
    poll(lambda: sorted(late) == [b"0 2", b"0 3", b"1 2", b"1 3"], f"what the bridge keeps: {late}")
    # A later sample is put once, even if it is sent again when the robots meet again.
    publishers[0].put(b"0 4", attachment=attachment(4, bytes(16)))
    poll(lambda: b"0 4" in present and b"0 4" in late, "what is new")
    bob.daemon.kill()
    wait_online(alice.daemon, "bob", online=False)
    bob.daemon.start()
    publishers[0].put(b"0 5", attachment=attachment(5, bytes(16)))
    poll(lambda: b"0 5" in present, "what came after they met again")
    alice.put_until_seen(bob, "demo/after", b"all cached samples came before")
    assert len(present) == len(set(present)) == 6
    # The cache is dropped with its publisher.
    token.undeclare()
    poll(lambda: bob.tokens.get(KEPT_TOKEN) is False, "the publisher gone")

    def nothing_kept() -> bool:
        replies = bob.session.get(f"{KEPT}/@adv/**?_anyke", consolidation=zenoh.ConsolidationMode.NONE)
        return not [reply for reply in replies if reply.ok is not None]

    poll(nothing_kept, "nothing kept at bob")
    for declared in [*publishers, *kept]:
        declared.undeclare()


def test_a_restarted_daemon_is_found_again(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.daemon.kill()
    alice.daemon.start()
    alice.put_until_seen(bob, "demo/again", b"after the restart")
    assert bob.bridge is not None
    assert bob.bridge.poll() is None


def test_a_bridge_asks_for_the_topics_that_it_is_to_receive(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.stop_bridge()
    bob.start_bridge(more=("--receive", "status", "--receive", "video rate_hz=5 max_age_s=2"))

    def reads() -> list[dict[str, Any]] | None:
        with alice.daemon.client() as client:
            # Asks if it is not known yet.
            client.publish("map", b"", to="bob")
            (peer,) = client.request("subscriptions")["peers"]
            found: list[dict[str, Any]] | None = peer["reads"]
        return found if found is not None and len(found) == 3 else None

    assert poll(reads, "alice knows what bob's bridge receives") == [
        {"topics": "bridge/zenoh", "rate_hz": None, "max_age_s": None},
        {"topics": "status", "rate_hz": None, "max_age_s": None},
        {"topics": "video", "rate_hz": 5.0, "max_age_s": 2.0},
    ]
    bob.stop_bridge()
    bob.start_bridge()
    alice.put_until_seen(bob, "demo/after", b"everything again")
