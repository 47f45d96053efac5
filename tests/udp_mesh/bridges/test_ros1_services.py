"""Services and actions of two robots with a real ROS 1 master each: what is asked ends with an answer or a reason."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import pytest

from tests.udp_mesh.bridges.ros1_processes import Master, Ros1Bridge, Ros1Node
from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons, wait_online

pytestmark = pytest.mark.xdist_group("ros1")

CONFIGURATION = """
services:
  /add: { timeout_s: 10 }
  /slow: { timeout_s: 1 }
  /refuses: { timeout_s: 10 }
  /stuck: { timeout_s: 600 }
  /nobody: {}
actions:
  /test: { lost_s: 1 }
"""
SUCCEEDED, PREEMPTED, LOST = 3, 2, 9
ACTION = "/alice/mesh_comm/bob/test"
ADD, SLOW, REFUSES, STUCK, UNSERVED = (
    f"/alice/mesh_comm/bob/{name}" for name in ("add", "slow", "refuses", "stuck", "nobody")
)


@dataclass
class Robot:
    daemon: RunningDaemon
    master: Master
    bridge: Ros1Bridge
    node: Ros1Node


@pytest.fixture(scope="module")
def team() -> Iterator[tuple[Robot, Robot]]:
    """Alice offers services; bob calls them."""
    with two_daemons() as daemons, ExitStack() as kept:
        robots = []
        for daemon in daemons:
            master = Master(daemon.folder, daemon.name)
            kept.callback(master.stop)
            master.start_bare()
            file = daemon.folder / f"{daemon.name}-bridge.yaml"
            file.write_text(CONFIGURATION if daemon.name == "alice" else "")
            bridge = Ros1Bridge(master, daemon)
            kept.callback(bridge.stop)
            bridge.start(arguments=[f"_config:={file}"])
            node = Ros1Node(master, f"{daemon.name}_node")
            kept.callback(node.close)
            robots.append(Robot(daemon, master, bridge, node))
        alice, bob = robots
        for service, more in (
            ("/add", {}),
            ("/slow", {"delay_s": 5}),
            ("/refuses", {"refuse": True}),
            ("/stuck", {"delay_s": 300}),
        ):
            alice.node.serve(service, **more)
        alice.node.serve_action("/test")
        for name in (ADD, SLOW, REFUSES, STUCK):
            poll(lambda: bob.node.exists(name), name)  # noqa: B023
        yield alice, bob


def answer(node: Ros1Node, service: str, a: int, b: int) -> object:
    node.add(service, a, b)
    found = node.expect("added", service)
    return found.get("sum", found.get("error"))


def test_a_service_of_another_robot_is_called_without_its_package(team: tuple[Robot, Robot]) -> None:
    _, bob = team
    assert answer(bob.node, ADD, 2, 40) == 42


def test_the_servers_own_error_reaches_the_caller(team: tuple[Robot, Robot]) -> None:
    _, bob = team
    assert "no sums today" in str(answer(bob.node, REFUSES, 1, 1))


def test_a_call_ends_at_its_deadline_with_the_reason(team: tuple[Robot, Robot]) -> None:
    _, bob = team
    found = str(answer(bob.node, SLOW, 1, 1))
    # the deadline is alice's, too, for her server: whichever notices first
    assert re.search(r"no response from (alice|its server) within 1 s; the call may have been executed", found)


def test_only_services_with_a_server_are_offered(team: tuple[Robot, Robot]) -> None:
    _, bob = team
    assert not bob.node.exists(UNSERVED)


def test_an_action_of_another_robot_gives_a_result(team: tuple[Robot, Robot]) -> None:
    _, bob = team
    bob.node.goal(ACTION, 41)
    assert bob.node.expect("available")["available"]
    ended = bob.node.expect("ended", ACTION)
    assert (ended["state"], ended["result"]) == (SUCCEEDED, 42)


def test_an_action_of_another_robot_gives_feedback_and_is_canceled(team: tuple[Robot, Robot]) -> None:
    _, bob = team
    bob.node.goal(ACTION, -1)
    assert bob.node.expect("feedback")["feedback"] == 7
    bob.node.cancel(ACTION)
    ended = bob.node.expect("ended", ACTION)
    assert (ended["state"], ended["result"]) == (PREEMPTED, -1)


def test_a_masters_restart_does_not_lose_the_other_robots_services(team: tuple[Robot, Robot]) -> None:
    _, bob = team
    bob.master.stop()
    bob.master.start_bare()
    poll(lambda: bob.node.exists(ADD), "the service at the new master")
    assert answer(bob.node, ADD, 1, 2) == 3


def test_calls_end_and_services_go_when_the_peer_does_and_return_with_it(team: tuple[Robot, Robot]) -> None:
    alice, bob = team
    bob.node.add(STUCK, 1, 1)
    alice.node.expect("serving", "/stuck")
    bob.node.goal(ACTION, -2)
    alice.node.expect("executing", -2)
    alice.daemon.kill()
    found = bob.node.expect("added", STUCK)
    assert "alice is offline; the call may have been executed" in found["error"]
    assert bob.node.expect("ended", ACTION)["state"] == LOST
    poll(lambda: not bob.node.exists(ADD), "the service to be gone")
    alice.daemon.start()
    wait_online(bob.daemon, "alice")
    poll(lambda: bob.node.exists(ADD), "the service to be back")
    assert answer(bob.node, ADD, 5, 6) == 11


def test_a_service_whose_server_ends_is_withdrawn(team: tuple[Robot, Robot]) -> None:
    alice, bob = team
    alice.node.close()
    poll(lambda: not bob.node.exists(ADD), "the service to be gone")
