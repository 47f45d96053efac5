"""A team of four robots and a base on one lossy link, each with a network and a roscore of its own. Needs
scripts/setup-ros."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.udp_mesh.bridges.bridge_processes import stop
from tests.udp_mesh.bridges.ros1_processes import Master, Ros1Node
from tests.udp_mesh.bridges.ros_team import Member, team
from tests.udp_mesh.daemon.processes import poll, wait_online

pytestmark = [pytest.mark.proof, pytest.mark.xdist_group("ros1")]

ROBOTS = ("base", "ugv1", "ugv2", "ugv-3", "uav1")


def ros(member: Member) -> str:
    """Its name in ROS names."""
    return member.name.replace("-", "_")


def to(source: Member, target: Member, topic: str) -> str:
    return f"/{ros(source)}/mesh_comm/{ros(target)}/{topic}"


@pytest.fixture(scope="module")
def members() -> Iterator[list[Member]]:
    with team(*ROBOTS) as (_, found):
        yield found


@contextmanager
def program(master: Master, log_name: str, *words: str) -> Iterator[None]:
    """A program of this robot for as long as the block runs."""
    process = master.spawn(log_name, *words)
    try:
        yield
    finally:
        stop(process)


def test_every_robot_hears_every_other(members: list[Member]) -> None:
    for target in members:
        for source in members:
            if source is not target:
                target.node.subscribe(to(source, target, "status"))
    for source in members:
        for target in members:
            if source is not target:
                text = f"{source.name} to {target.name}"
                heard = source.node.publish_until_received(to(source, target, "status"), text, target.node)
                assert heard["name"] == to(source, target, "status")


def test_a_broadcast_reaches_the_whole_team(members: list[Member]) -> None:
    base, *others = members
    for member in others:
        member.node.subscribe(to(base, member, "map"))
    for member in others:
        base.node.publish_until_received(
            "/base/mesh_comm/map", f"for all, {member.name} last", member.node, received_as=to(base, member, "map")
        )


def test_a_burst_over_a_lossy_link_arrives_complete_and_without_duplicates(members: list[Member]) -> None:
    base, ugv1, *_ = members
    base.node.subscribe(to(ugv1, base, "map"))
    ugv1.node.publish_until_received(to(ugv1, base, "map"), "there", base.node)
    ugv1.node.publish(to(ugv1, base, "map"), "burst ", repeat=500)

    def burst() -> list[str]:
        return [line["data"] for line in base.node.received() if str(line.get("data")).startswith("burst ")]

    poll(lambda: len(burst()) >= 500, "the burst")
    assert sorted(burst()) == sorted(f"burst {number}" for number in range(500))


def test_a_returning_robot_receives_messages_latched_while_it_was_offline(members: list[Member]) -> None:
    base, _, _, _, uav1 = members
    uav1.daemon.stop()
    wait_online(base.daemon, "uav1", online=False)
    base.node.publish("/base/mesh_comm/any", "go home", latch=True)
    uav1.daemon.start()
    late = Ros1Node(uav1.master, "late")
    late.subscribe(to(base, uav1, "any"))
    assert late.expect("data", "go home")["latching"] == "1"
    late.close()


def test_messages_flow_after_master_restarts_on_both_sides(members: list[Member]) -> None:
    base, ugv1, ugv2, *_ = members
    for member in (ugv1, base):
        member.master.stop()
        member.master.start()
    fresh = Ros1Node(base.master, "fresh")
    fresh.subscribe(to(ugv1, base, "status"))
    sender = Ros1Node(ugv1.master, "fresh")
    sender.publish_until_received(to(ugv1, base, "status"), "both restarted", fresh)
    fresh.subscribe(to(ugv2, base, "status"))
    ugv2.node.publish_until_received(to(ugv2, base, "status"), "and the others", fresh)
    fresh.close()
    sender.close()


def test_rostopic_echo_info_and_hz_work_on_a_relayed_topic(members: list[Member]) -> None:
    base, ugv1, *_ = members
    ugv1.node.stream(to(ugv1, base, "odometry"), "std_msgs/String", rate_hz=20.0)
    name = to(ugv1, base, "odometry")
    poll(lambda: name in base.master.command("rostopic", "list"), "the topic")
    assert "number" in base.master.command("rostopic", "echo", "-n", "2", name)
    assert "std_msgs/String" in base.master.command("rostopic", "info", name)
    with program(base.master, "hz.log", "rostopic", "hz", name):
        poll(lambda: "average rate" in (base.master.folder / "hz.log").read_text(), "a rate")
    assert ugv1.node.stop_streams()[name] > 0


def test_a_recorded_bag_is_played_back_through_the_bridge(members: list[Member]) -> None:
    base, ugv1, ugv2, *_ = members
    bag = base.master.folder / "run.bag"
    name = to(ugv1, base, "bagged")
    for member in (base, ugv1, ugv2):
        with member.daemon.client() as client:
            client.request("set-topic", topic="bagged", values={"priority": 4})
    base.node.subscribe(name)
    ugv1.node.publish_until_received(name, "bag ready", base.node)
    record = base.master.spawn("record.log", "/usr/lib/rosbag/record", "--lz4", "-O", str(bag), name)
    poll(lambda: "/record_" in base.master.command("rostopic", "info", name), "the recorder")
    for number in range(10):
        ugv1.node.publish_until_received(name, f"for the bag {number}", base.node)
    stop(record, signal.SIGINT)
    about = base.master.command("rosbag", "info", str(bag))
    assert name in about
    assert "std_msgs/String [992ce8a1687cec8c8bd883ec73ca41d1]" in about
    # On the base, where no program ever knew the type; back out to another robot.
    ugv2.node.subscribe(to(base, ugv2, "bagged"))

    def played() -> bool:
        base.master.command(
            "/usr/lib/rosbag/play", "-q", "--wait-for-subscribers", str(bag), f"{name}:={to(base, ugv2, 'bagged')}"
        )
        return any(str(line.get("data")).startswith("for the bag") for line in ugv2.node.received())

    poll(played, "what was recorded")


def test_topic_tools_relay_and_throttle_work_on_a_relayed_topic(members: list[Member]) -> None:
    base, ugv1, *_ = members
    name, relayed, throttled = to(ugv1, base, "status"), "/relayed", "/throttled"
    with (
        program(base.master, "relay.log", "/usr/lib/topic_tools/relay", name, relayed),
        program(base.master, "throttle.log", "/usr/lib/topic_tools/throttle", "messages", name, "100.0", throttled),
    ):
        base.node.subscribe(relayed)
        base.node.subscribe(throttled)

        def came() -> set[str]:
            ugv1.node.publish(name, "tools")
            return {line["name"] for line in base.node.received() if line.get("data") == "tools"}

        poll(lambda: came() >= {relayed, throttled}, "both")


def test_messages_from_a_sender_side_topic_tools_relay_are_forwarded(members: list[Member]) -> None:
    base, _, ugv2, *_ = members
    name = to(ugv2, base, "status")
    base.node.subscribe(name)
    with program(ugv2.master, "out.log", "/usr/lib/topic_tools/relay", "/local/status", name):
        ugv2.node.publish_until_received("/local/status", "by a relay", base.node, received_as=name)


def test_mesh_conditions_list_every_online_peer(members: list[Member]) -> None:
    base, *others = members
    base.node.subscribe("/base/mesh_conditions")

    def online() -> bool:
        peers = json.loads(base.node.expect("name", "/base/mesh_conditions")["data"])["peers"]
        return {peer["name"] for peer in peers if peer["online"]} == {member.name for member in others}

    poll(online, "all of them")
