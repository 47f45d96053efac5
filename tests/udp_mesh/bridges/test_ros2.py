"""Two robots with a real ROS 2 each, in networks and ROS domains of their own, on a lossy link that is cut."""

from __future__ import annotations

import json
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count, islice, permutations
from pathlib import Path

import pytest

from benchmarks.link.laboratory import Laboratory, Link, laboratory
from tests.udp_mesh.bridges.ros2_processes import PYTHON, Ros2Bridge, Ros2Node, hear_only_loopback
from tests.udp_mesh.bridges.ros_team import RobotsDaemon
from tests.udp_mesh.daemon.processes import RATES, RunningDaemon, poll, wait_online
from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh.bridges.message_codec import decode, encode
from udp_mesh.bridges.transforms import DEFINITION
from udp_mesh.bridges.types import MessageKind, TypeKey, kind_text

pytestmark = pytest.mark.xdist_group("ros2")

LINK = Link(rate=20e6, delay_ms=5.0, loss=0.05)
CYCLONE = Path(__file__).with_name("cyclone_program.py")
TF_TYPE = "tf2_msgs/msg/TFMessage"
DOMAINS = {"alice": 71, "bob": 72}
TO_BOB = "/alice/mesh_comm/bob/status"
TO_BOB_MAP = "/alice/mesh_comm/bob/map"
TO_ALICE = "/bob/mesh_comm/alice/status"


CONFIGURATION = """
topics:
  history: { depth: 4 }
  slow: { rate_hz: 2 }
tf: { rate_hz: 5 }
services:
  /reset: { timeout_s: 2 }
  /mute: { timeout_s: 1 }
actions:
  /count: { timeout_s: 5, lost_s: 60 }
  /short: { timeout_s: 5, lost_s: 0.5 }
"""
TOPICS = """
[topics]
status = { priority = 0 }
map = { priority = 5 }
history = { priority = 5 }
camera = { priority = 5 }
slow = { priority = 5 }
echo = { priority = 5 }
"""
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


@dataclass
class Side:
    daemon: RunningDaemon
    bridge: Ros2Bridge
    node: Ros2Node


@dataclass
class Team:
    lab: Laboratory
    alice: Side
    bob: Side

    def cut(self) -> None:
        """Nothing crosses the link from now on; both robots have noticed."""
        self.lab.set(loss=1.0)
        wait_online(self.alice.daemon, "bob", online=False)
        wait_online(self.bob.daemon, "alice", online=False)

    def join(self) -> None:
        self.lab.set(loss=LINK.loss)
        wait_online(self.alice.daemon, "bob")
        wait_online(self.bob.daemon, "alice")


@pytest.fixture(scope="module")
def whole() -> Iterator[Team]:
    """Two robots, each in a network and a ROS domain of its own, on one lossy link, which has room for a third."""
    # A Unix socket's path has at most 107 bytes: pytest's folders are too long.
    with (
        tempfile.TemporaryDirectory(prefix="udp-mesh-") as path,
        laboratory(3, link=LINK) as lab,
        ExitStack() as kept,
    ):
        sides = []
        for place, (name, domain) in enumerate(DOMAINS.items()):
            hear_only_loopback(lab, place)
            inside = lab.inside(place, [])
            daemon = RobotsDaemon(Path(path), name, inside, TOPICS, RATES)
            kept.enter_context(daemon)
            arguments = ["--ros-args", "-r", f"/{name}/mesh_comm/camera:=/sensors/front/camera"]
            if name == "alice":
                # as launch files give it to all nodes; there is no /clock
                arguments += ["-p", "use_sim_time:=true"]
            bridge = Ros2Bridge(daemon, domain, inside, CONFIGURATION, *arguments)
            kept.callback(bridge.stop)
            bridge.start()
            node = Ros2Node(daemon.folder, f"{name}_node", domain, inside)
            kept.callback(node.close)
            sides.append(Side(daemon, bridge, node))
        made = Team(lab, *sides)
        made.join()
        yield made


@pytest.fixture
def team(whole: Team) -> tuple[Side, Side]:
    return whole.alice, whole.bob


def test_messages_cross_in_both_directions(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.node.subscribe(TO_BOB)
    alice.node.subscribe(TO_ALICE)
    alice.node.publish_until_received(TO_BOB, "from alice", bob.node)
    bob.node.publish_until_received(TO_ALICE, "from bob", alice.node)


def test_the_first_message_of_a_topic_reaches_an_existing_subscriber(team: tuple[Side, Side]) -> None:
    alice, bob = team
    names = [f"/alice/mesh_comm/bob/once{number}" for number in range(5)]
    last = "/alice/mesh_comm/bob/last"
    for name in [*names, last]:
        bob.node.subscribe(name)
    kind = kind_text(MessageKind(TypeKey("std_msgs/msg/String", "reliable:volatile:10:")))
    with alice.daemon.client() as client:
        client.request("set-topic", topic="last", values={"priority": 0})

        def is_last_known() -> bool:
            client.publish("last", b"\0\1\0\0\5\0\0\0stop\0", to="bob", type=kind)
            return any(line.get("name") == last for line in bob.node.received())

        # the last of them is known to the bridge, and so are those before
        poll(is_last_known, "the last subscription to be known")
        for number in range(5):
            topic = f"once{number}"
            client.request("set-topic", topic=topic, values={"priority": 0})
            client.publish(topic, b"\0\1\0\0\5\0\0\0stop\0", to="bob", type=kind)
    for name in names:
        assert bob.node.expect("name", name)["data"] == "stop"


def test_two_robots_in_one_ros_graph_get_everything_once_and_so_does_a_third(whole: Team) -> None:
    alice, bob = whole.alice, whole.bob
    from_bob, from_alice, direct = "/bob/mesh_comm/echo", "/alice/mesh_comm/echo", "/bob/mesh_comm/carol/echo"
    with ExitStack() as kept:
        # a small message to all is a broadcast, of which a lossy link loses some
        kept.callback(whole.lab.set, loss=LINK.loss)
        whole.lab.set(loss=0.0)
        carol = RobotsDaemon(bob.daemon.folder, "carol", whole.lab.inside(2, []), TOPICS, RATES)
        kept.enter_context(carol)
        daemons = [alice.daemon, bob.daemon, carol]
        for one, other in permutations(daemons, 2):
            wait_online(one, other.name)
        # carol's, but in bob's graph: as if both robots had the same domain on a network that joins them
        bridge = Ros2Bridge(carol, DOMAINS["bob"], whole.lab.inside(1, []), CONFIGURATION)
        kept.callback(bridge.stop)
        bridge.start()
        advice = "ROS_DOMAIN_ID"
        poll(lambda: advice in bob.bridge.log.read_text() and advice in bridge.log.read_text(), "the advice")
        clients = [kept.enter_context(daemon.client()) for daemon in daemons]
        for client in clients:
            client.subscribe("echo", "tf")
        # published before the others: what bob's bridge reads at all, it reads when it reads those
        bob.node.subscribe(direct, depth=100)
        bob.node.publish_until_received(direct, "known", bob.node)
        for name in ("/alice/mesh_comm/bob/echo", "/alice/mesh_comm/carol/echo"):
            bob.node.subscribe(name, depth=100)
            alice.node.publish_until_received(from_alice, "known", bob.node, received_as=name)
        alice.node.subscribe("/bob/mesh_comm/alice/echo")
        bob.node.publish_until_received(from_bob, "known", alice.node, received_as="/bob/mesh_comm/alice/echo")
        texts = {name: [f"{number} from {name}" for number in range(5)] for name in ("alice", "bob")}
        for number in range(5):
            bob.node.publish(direct, f"{number} to carol")
            bob.node.publish(from_bob, texts["bob"][number])
            alice.node.publish(from_alice, texts["alice"][number])

        expected = {(to, "bob", text) for to in ("alice", "carol") for text in texts["bob"]}
        expected |= {(to, "alice", text) for to in ("bob", "carol") for text in texts["alice"]}
        heard: Counter[tuple[str, str, str]] = Counter()

        def is_complete() -> bool:
            bob.node.publish("/tf", {"cdr": transform("wheel")}, type=TF_TYPE)
            for daemon, client in zip(daemons, clients, strict=True):
                # in a circle, messages never end
                for message in islice(client.messages(0.1), 1000):
                    text = "tf" if message.topic == "tf" else message.payload[8:].rstrip(b"\0").decode()
                    heard[daemon.name, message.source, text] += 1
            return expected <= set(heard) and heard["alice", "bob", "tf"] > 3

        poll(is_complete, "everything at every robot")
        # ROS itself brought what is for carol alone, and the first of the two by name sent the transforms of both
        assert {each: times for each, times in heard.items() if each[2] not in ("known", "tf")} == Counter(expected)
        assert heard["alice", "carol", "tf"] == 0
        published = {(direct, text) for text in texts["bob"]}
        published |= {(direct, f"{number} to carol") for number in range(5)}
        published |= {(f"/alice/mesh_comm/{to}/echo", text) for to in ("bob", "carol") for text in texts["alice"]}

        def seen() -> Counter[tuple[str, str]]:
            lines = [line for line in bob.node.received() if line["name"].endswith("/echo")]
            return Counter((line["name"], line["data"]) for line in lines if line["data"] != "known")

        poll(lambda: published <= set(seen()), f"{published} in the shared graph")
        assert seen() == Counter(published)
    poll(lambda: "bridges-apart" in bob.bridge.log.read_text(), "the other bridge has gone")


def test_a_late_subscriber_receives_the_last_transient_local_message(team: tuple[Side, Side]) -> None:
    alice, bob = team
    with bob.daemon.client() as client:
        client.subscribe("map")
        alice.node.publish(TO_BOB_MAP, "the map", latched=True)
        poll(lambda: next(iter(client.messages(0.1)), None), "the map at bob's daemon")
    bob.node.subscribe(TO_BOB_MAP, latched=True)
    assert bob.node.expect("data", "the map")["name"] == TO_BOB_MAP


def test_programs_of_another_dds_vendor_send_and_receive(whole: Team) -> None:
    log = whole.bob.daemon.folder / "cyclone.log"
    programs = []
    try:
        with log.open("wb") as out:
            for place, role in enumerate(("publish", "subscribe")):
                command = [*whole.lab.inside(place, []), str(PYTHON), str(CYCLONE), role, TO_BOB]
                command.append(str(list(DOMAINS.values())[place]))
                programs.append(subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT))
        poll(lambda: "heard of another vendor" in log.read_text(), "a message from one to the other")
    finally:
        for program in programs:
            program.terminate()
            program.wait(WAIT_S)


def test_a_killed_bridge_resumes_after_a_restart(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.node.subscribe(TO_BOB)
    for side, data in ((alice, "sender restarted"), (bob, "receiver restarted")):
        side.bridge.kill()
        side.bridge.start()
        alice.node.publish_until_received(TO_BOB, data, bob.node)


def test_a_name_that_nothing_reads_is_reported(team: tuple[Side, Side]) -> None:
    alice, _ = team

    def reported() -> bool | None:
        alice.node.publish("/alice/mesh_comm/statsu", "for nobody")
        return "not-sent name=/alice/mesh_comm/statsu " in alice.bridge.log.read_text() or None

    poll(reported, "the report")
    # what robots read, offer or publish for each other is none of those
    assert alice.bridge.log.read_text().count("not-sent ") == 1


@pytest.mark.parametrize("name", ["made_up/msg/Thing", "os/path/join", "../msg/String", "std_msgs/msg/Nothing"])
def test_an_uninstalled_type_is_reported_and_does_not_stop_the_bridge(team: tuple[Side, Side], name: str) -> None:
    alice, bob = team
    kind = kind_text(MessageKind(TypeKey(name, "reliable:volatile:10:")))
    with alice.daemon.client() as client:
        client.publish("status", b"\0\1\0\0", to="bob", type=kind)
    poll(lambda: f"type-unknown type={name}" in bob.bridge.log.read_text() or None, "the report")
    bob.node.subscribe(TO_BOB)
    alice.node.publish_until_received(TO_BOB, f"after {name}", bob.node)


def test_late_subscribers_get_as_many_messages_as_the_configured_depth(team: tuple[Side, Side]) -> None:
    alice, bob = team
    name = "/alice/mesh_comm/bob/history"
    with bob.daemon.client() as client:
        client.subscribe("history")
        heard: set[bytes] = set()
        for number in range(6):
            alice.node.publish(name, f"entry {number}", latched=True, depth=4)

        def complete() -> bool:
            heard.update(message.payload[8:15] for message in client.messages(0.1))
            return b"entry 5" in heard and len(heard) >= 4

        poll(complete, "the history at bob's daemon")
    # the bridge of a robot that was started after all that gets them from the other robot's
    bob.bridge.kill()
    bob.bridge.start()
    bob.node.subscribe(name, latched=True)
    for number in range(2, 6):
        bob.node.expect("data", f"entry {number}")
    assert not [line for line in bob.node.received() if line["data"] in ("entry 0", "entry 1")]


def test_a_best_effort_publisher_stays_one_on_the_other_robot(team: tuple[Side, Side]) -> None:
    alice, bob = team
    name = "/alice/mesh_comm/bob/camera"
    bob.node.subscribe(name, best_effort=True)
    alice.node.publish_until_received(name, "a frame", bob.node, best_effort=True)
    with bob.daemon.client() as client:
        client.subscribe("camera")

        def kind() -> str | None:
            alice.node.publish(name, "a frame", best_effort=True)
            return next((message.type for message in client.messages(0.2)), None)

        assert poll(kind, "the type").startswith("std_msgs/msg/String best_effort:volatile:10:RIHS01_")


def test_network_conditions_are_published_as_json(team: tuple[Side, Side]) -> None:
    alice, _ = team
    alice.node.subscribe("/alice/mesh_conditions")
    conditions = json.loads(alice.node.expect("name", "/alice/mesh_conditions")["data"])
    assert ("bob", True) in [(peer["name"], peer["online"]) for peer in conditions["peers"]]


def test_a_remapped_topic_is_sent_under_its_mesh_name(team: tuple[Side, Side]) -> None:
    alice, bob = team
    received = "/alice/mesh_comm/bob/camera"
    bob.node.subscribe(received)
    alice.node.publish_until_received("/sensors/front/camera", "remapped", bob.node, received_as=received)


def test_a_topic_with_a_lower_rate_is_throttled(team: tuple[Side, Side]) -> None:
    alice, bob = team
    with bob.daemon.client() as client:
        client.subscribe("slow")
        arrived = published = 0

        def enough() -> bool:
            nonlocal arrived, published
            # many at a time: on a busy machine single ones would not come faster than the rate
            for _ in range(20):
                alice.node.publish("/alice/mesh_comm/bob/slow", f"number {published}")
                published += 1
            arrived += len(list(client.messages(0.04)))
            return arrived >= 4

        poll(enough, "four messages at bob's daemon")
        assert published > 4 * arrived


def test_a_type_with_another_hash_is_reported_and_not_published(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.node.subscribe("/alice/mesh_comm/bob/map")
    kind = kind_text(MessageKind(TypeKey("std_msgs/msg/String", "reliable:volatile:10:RIHS01_" + "0" * 64)))

    def reported() -> bool:
        with alice.daemon.client() as client:
            client.publish("map", b"\0\1\0\0\6\0\0\0other\0", to="bob", type=kind)
        return "another definition of the type" in bob.bridge.log.read_text()

    poll(reported, "the report")


def test_transforms_of_many_nodes_are_sent_together(team: tuple[Side, Side]) -> None:
    alice, bob = team
    with bob.daemon.client() as client:
        client.subscribe("tf", "tf_static")
        seen: dict[str, set[str]] = {"tf": set(), "tf_static": set()}
        sensors = count()

        def complete() -> bool:
            for child in ("wheel", "arm", "head"):
                alice.node.publish("/tf", {"cdr": transform(child)}, type=TF_TYPE)
            # static ones travel when they change, all of them: a new one repeats what a late client has missed
            for child in ("lidar", f"sensor{next(sensors)}"):
                alice.node.publish("/tf_static", {"cdr": transform(child)}, type=TF_TYPE, latched=True)
            for message in client.messages(0.1):
                decoded = decode(DEFINITION, message.payload, 2)["transforms"]
                seen[message.topic] |= {each["child_frame_id"] for each in decoded}
            return seen["tf"] == {"wheel", "arm", "head"} and seen["tf_static"] >= {"lidar", "sensor0"}

        poll(complete, "all transforms")


def test_a_service_of_another_robot_is_called(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.node.request("serve", "/reset")
    bob.node.request("call", "/alice/mesh_comm/bob/reset")
    found = bob.node.expect("answer", "/alice/mesh_comm/bob/reset")
    assert (found["success"], found["message"]) == (True, "done")
    alice.node.expect("served", "/reset")


def test_a_service_that_does_not_respond_ends_with_an_error_at_its_deadline(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.node.request("serve", "/mute", mute=True)
    bob.node.request("call", "/alice/mesh_comm/bob/mute")
    found = bob.node.expect("answer", "/alice/mesh_comm/bob/mute")
    assert (found["success"], found["message"]) == (
        False,
        "no response from alice within 1 s; the call may have been executed",
    )


def test_an_action_of_another_robot_gives_feedback_and_a_result_and_can_be_canceled(team: tuple[Side, Side]) -> None:
    alice, bob = team
    name = "/alice/mesh_comm/bob/count"
    alice.node.request("serve_action", "/count", pause_s=0.1)
    bob.node.request("goal", name, order=4)
    assert bob.node.expect("accepted")["accepted"] is True
    assert bob.node.expect("feedback", name)["sequence"][:2] == [0, 1]
    found = bob.node.expect("result", name)
    assert (found["sequence"], found["status"]) == ([0, 1, 1, 2, 3, 5], SUCCEEDED)
    bob.node.request("goal", name, order=1000)
    assert bob.node.expect("accepted")["accepted"] is True
    bob.node.request("cancel", name)
    assert bob.node.expect("canceling")["canceling"] == 1
    assert bob.node.expect("result", name)["status"] == CANCELED


def test_a_cut_ends_calls_and_short_actions_and_nothing_else(whole: Team) -> None:
    alice, bob = whole.alice, whole.bob
    count, short = "/alice/mesh_comm/bob/count", "/alice/mesh_comm/bob/short"
    alice.node.request("serve_action", "/short", pause_s=0.1)
    for name, order in ((short, 1000), (count, 60)):
        bob.node.request("goal", name, order=order)
        assert bob.node.expect("accepted")["accepted"] is True
    # A busy caller reads the response after the service was withdrawn.
    bob.node.process.send_signal(signal.SIGSTOP)
    try:
        whole.cut()
        poll(lambda: "service=/short/_action/get_result" in bob.bridge.log.read_text(), "the call has been ended")
        # what the bridge does with the service after its response, nothing outside of it shows
        time.sleep(1.0)
    finally:
        bob.node.process.send_signal(signal.SIGCONT)
    assert bob.node.expect("result", short)["status"] == ABORTED
    poll(lambda: not bob.node.is_available("/alice/mesh_comm/bob/reset"), "reset is gone")
    whole.join()
    assert bob.node.expect("result", count)["status"] == SUCCEEDED
    bob.node.request("call", "/alice/mesh_comm/bob/reset")
    assert bob.node.expect("answer", "/alice/mesh_comm/bob/reset")["success"] is True
    bob.node.subscribe(TO_BOB)
    alice.node.publish_until_received(TO_BOB, "after the cut", bob.node)


def test_a_restarted_daemon_is_taken_up_again(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.daemon.kill()
    alice.daemon.start()
    wait_online(alice.daemon, "bob")
    bob.node.subscribe(TO_BOB)
    alice.node.publish_until_received(TO_BOB, "after the daemon's restart", bob.node)


def transform(child: str) -> str:
    """A tf2_msgs/msg/TFMessage of one transform, as hex."""
    stamped = {"header": {"frame_id": "base"}, "child_frame_id": child}
    return encode(DEFINITION, {"transforms": [stamped]}, 2).hex()
