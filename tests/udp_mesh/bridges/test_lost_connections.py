"""When the ROS 1 bridge registers a name once more."""

from __future__ import annotations

from udp_mesh.bridges.ros1.lost_connections import MAX_TRIES, LostConnections


def test_a_name_is_due_when_connections_are_missing_in_two_checks_in_a_row() -> None:
    lost = LostConnections()
    listed = {"/a": ["/camera"], "/b": ["/camera", "/lidar"], "/of-others": ["/x"]}
    assert lost.due({"/a": 0, "/b": 2, "/c": 0}, listed) == []
    assert lost.due({"/a": 0, "/b": 1, "/c": 0}, listed) == ["/a"]
    assert lost.due({"/a": 1, "/b": 1, "/c": 0}, listed) == ["/b"]
    assert lost.due({"/a": 0, "/b": 2, "/c": 0}, listed) == []


def test_a_killed_node_that_the_master_still_lists_is_given_up_until_another_is_missing() -> None:
    lost = LostConnections()
    killed, two = {"/a": ["/killed"]}, {"/a": ["/killed", "/busy"]}
    found = [lost.due({"/a": 0}, killed) for _ in range(MAX_TRIES + 10)]
    assert found == [[], *[["/a"]] * MAX_TRIES, *[[]] * 9]
    assert [lost.due({"/a": 0}, two) for _ in range(2)] == [[], ["/a"]]
