"""A legacy robot knows others by their address: ours may change, and there may be several."""

from __future__ import annotations

from tests.udp_mesh.core.test_legacy import OLD, OldRobot
from udp_mesh.core.events import MessageDelivered
from udp_mesh.core.settings import LinkInfo, LinkKind
from udp_mesh.wire.legacy import Host, LegacyAck, LegacyType, encode_legacy


def finish(old: OldRobot) -> set[int]:
    """Acknowledge everything that is sent from now on. The numbers of the messages whose fragments all came."""
    came: dict[int, set[int]] = {}
    done = set()
    for _ in range(40):
        for fragment in old.hear_payloads():
            came.setdefault(fragment.sequence, set()).add(fragment.position)
            if len(came[fragment.sequence]) == fragment.total:
                done.add(fragment.sequence)
            old.say(LegacyAck(fragment.sequence, fragment.position))
        old.now += 0.01
    return done


def test_a_message_under_way_is_sent_again_when_our_address_changes() -> None:
    """The legacy robot knows us by our address: it holds the first fragments of a robot that is gone."""
    old = OldRobot()
    old.node.send("map", bytes(8000), destination="old", now=old.now)
    for fragment in old.hear_payloads():
        old.say(LegacyAck(fragment.sequence, fragment.position))
    old.node.link_up(LinkInfo("mesh", LinkKind.BROADCAST, ("10.0.0.77", 8700), ("10.0.0.255", 8700)), old.now)
    assert len(finish(old)) == 1
    assert [event for event in old.events() if isinstance(event, MessageDelivered)]


def test_a_legacy_robot_heard_over_two_links_is_sent_to_over_one() -> None:
    """Its broadcasts arrive over both, and fragments from two addresses would never make a message there."""
    old = OldRobot()
    wired = LinkInfo("wire", LinkKind.BROADCAST, ("10.0.1.1", 8700), ("10.0.1.255", 8700))
    old.node.link_up(wired, old.now)
    links = set()
    old.node.send("map", bytes(8000), destination="old", now=old.now)
    for turn in range(400):
        if not turn % 50:
            for link in ("mesh", "wire"):
                old.node.receive(encode_legacy(Host("old", "10.0.0.9")), link, OLD, old.now)
        while datagrams := old.node.datagrams_to_send(old.now):
            links |= {datagram.link for datagram in datagrams if datagram.data[0] == LegacyType.PAYLOAD}
        old.node.handle_timer(old.now)
        old.now += 0.01
    assert links == {"mesh"}
    old.node.link_down("mesh", old.now)
    old.node.receive(encode_legacy(Host("old", "10.0.0.9")), "wire", OLD, old.now)
    assert {datagram.link for datagram in old.node.datagrams_to_send(old.now)} == {"wire"}
