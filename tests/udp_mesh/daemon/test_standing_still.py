"""A daemon that is suspended until the others consider it offline, and then continues."""

import signal

import pytest

from tests.udp_mesh.daemon.processes import collect, outcomes, poll, two_daemons, wait_online
from udp_mesh.client import MeshClient

pytestmark = pytest.mark.xdist_group("udp_mesh_kills")

MAPS = [bytes([number]) * 3_000_000 for number in range(4)]


def under_way(client: MeshClient) -> bool:
    """Whether a good piece of the maps has left."""
    return bool(client.request("status")["conditions"]["counters"]["fragments_sent"] > 200)


@pytest.mark.parametrize("still", ["sender", "receiver"])
def test_a_daemon_suspended_mid_transfer_loses_and_duplicates_nothing(still: str) -> None:
    with two_daemons() as (alice, bob), alice.client() as sender, bob.client() as receiver:
        receiver.subscribe("*")
        stopped, other = (alice, bob) if still == "sender" else (bob, alice)
        numbers = [sender.publish("map", payload, to="bob", notify=True) for payload in MAPS]
        poll(lambda: under_way(sender), "the maps are under way")
        stopped.signal(signal.SIGSTOP)
        try:
            wait_online(other, stopped.name, online=False)
            urgent = [b"%d" % number for number in range(50)] if still == "receiver" else []
            numbers += [sender.publish("status", payload, to="bob", notify=True) for payload in urgent]
        finally:
            stopped.signal(signal.SIGCONT)
        arrived = [message.payload for message in collect(receiver, len(numbers))]
        assert sorted(arrived) == sorted([*MAPS, *urgent])
        assert outcomes(sender, len(numbers)) == dict.fromkeys(numbers, "delivered")
        wait_online(alice, "bob")
        wait_online(bob, "alice")
        sender.publish("status", b"last", to="bob")
        assert [message.payload for message in collect(receiver, 1)] == [b"last"]
