"""Daemons behind relays, each in a network namespace of its own."""

from tests.udp_mesh.daemon.veth_links import run_as_root


def test_two_daemons_meet_through_a_relay_and_go_on_through_another_when_it_is_killed() -> None:
    run_as_root("tests.udp_mesh.daemon.relay_namespaces")
