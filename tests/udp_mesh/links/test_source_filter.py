"""Marked and other datagrams of known peers and those of strangers arrive at sockets of their own."""

from __future__ import annotations

import select
import socket
from contextlib import closing
from pathlib import Path

import pytest

from tests.udp_mesh.links.sockets import Out, free_port, open_link
from udp_mesh.links import source_filter
from udp_mesh.links.attachments import Address, Attachment
from udp_mesh.links.source_filter import ACCEPT, DROP, MAX_INSTRUCTIONS, source_program
from udp_mesh.links.udp import UdpLink

ALICE, BOB, EVE = "127.0.1.2", "127.0.1.3", "127.0.1.4"
INSTRUCTION_BYTES = 8

needs_ipv6 = pytest.mark.skipif(not Path("/proc/net/if_inet6").exists(), reason="this kernel has no IPv6")


def arrivals(link: UdpLink, count: int) -> tuple[list[bytes], list[bytes]]:
    """What arrived from (peers, strangers), `count` datagrams in all."""
    found: tuple[list[bytes], list[bytes]] = ([], [])
    while len(found[0]) + len(found[1]) < count:
        assert select.select([link.fileno(), link.unmarked_fileno(), link.strangers_fileno()], [], [], 60.0)[0]
        link.receive(lambda data, _source, _at: found[0].append(bytes(data)), 100)
        link.receive_unmarked(lambda data, _source, _at: found[0].append(bytes(data)), 100)
        link.receive_from_strangers(lambda data, _source, _at: found[1].append(bytes(data)), 100)
    return found


def test_a_peer_and_a_stranger_arrive_at_different_sockets() -> None:
    port = free_port()
    with (
        closing(open_link(ALICE, port)) as alice,
        closing(open_link(BOB, port)) as bob,
        closing(open_link(EVE, port)) as eve,
        socket.socket(type=socket.SOCK_DGRAM) as other_port,
    ):
        other_port.bind((BOB, 0))

        def from_each() -> tuple[list[bytes], list[bytes]]:
            bob.send([Out(b"bob", (ALICE, port))])
            eve.send([Out(b"eve", (ALICE, port))])
            other_port.sendto(b"other port", (ALICE, port))
            return arrivals(alice, 3)

        assert from_each() == ([], [b"bob", b"eve", b"other port"])
        assert alice.set_peers(frozenset({(BOB, port)}))
        assert from_each() == ([b"bob"], [b"eve", b"other port"])
        assert alice.set_peers(frozenset({(EVE, port), ("10.9.9.9", 1)}))
        assert from_each() == ([b"eve"], [b"bob", b"other port"])
        assert alice.set_peers(frozenset())
        assert from_each() == ([], [b"bob", b"eve", b"other port"])


def by_mark(link: UdpLink, count: int) -> tuple[list[bytes], list[bytes], list[bytes]]:
    """What arrived (marked, unmarked, from strangers), `count` datagrams in all."""
    found: tuple[list[bytes], list[bytes], list[bytes]] = ([], [], [])
    while sum(map(len, found)) < count:
        assert select.select([link.fileno(), link.unmarked_fileno(), link.strangers_fileno()], [], [], 60.0)[0]
        link.receive(lambda data, _source, _at: found[0].append(bytes(data)), 100)
        link.receive_unmarked(lambda data, _source, _at: found[1].append(bytes(data)), 100)
        link.receive_from_strangers(lambda data, _source, _at: found[2].append(bytes(data)), 100)
    return found


def test_what_a_peer_marks_as_urgent_arrives_at_a_socket_of_its_own() -> None:
    port = free_port()
    with (
        closing(open_link(ALICE, port)) as alice,
        closing(open_link(BOB, port, urgent_dscp=46)) as bob,
        closing(open_link(EVE, port, urgent_dscp=46)) as eve,
    ):
        alice.set_peers(frozenset({(BOB, port)}))
        to_alice = (ALICE, port)
        bob.send([Out(b"stop", to_alice, urgent=True), Out(b"map", to_alice)])
        eve.send([Out(b"forged", to_alice, urgent=True)])
        assert by_mark(alice, 3) == ([b"stop"], [b"map"], [b"forged"])


@needs_ipv6
def test_marks_of_ipv6_datagrams_are_seen() -> None:
    port = free_port()
    attachment = Attachment("lo6", "lo", ("::1", port), None, 65_535, 1)
    with closing(UdpLink(attachment)) as link, socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as far:
        far.bind(("::1", 0))
        link.set_peers(frozenset({("::1", far.getsockname()[1])}))
        for dscp, data in ((46, b"stop"), (0, b"map")):
            far.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_TCLASS, dscp << 2)
            far.sendto(data, ("::1", port))
        assert by_mark(link, 2) == ([b"stop"], [b"map"], [])


@needs_ipv6
def test_ipv6_addresses_are_compared_in_full() -> None:
    port = free_port()
    attachment = Attachment("lo6", "lo", ("::1", port), None, 65_535, 1)
    with closing(UdpLink(attachment)) as link, socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as far:
        far.bind(("::1", 0))
        own: Address = ("::1", far.getsockname()[1])
        for peers, place in ((frozenset({own}), 0), (frozenset({("1::1", own[1]), ("::2", own[1])}), 1)):
            assert link.set_peers(peers)
            far.sendto(b"x", ("::1", port))
            assert arrivals(link, 1)[place] == [b"x"]


def test_the_filter_for_a_large_team_stays_within_the_kernel_limit() -> None:
    port = free_port()
    team = frozenset((f"10.0.{number // 250}.{number % 250 + 1}", 8700) for number in range(1000))
    program = source_program(team, socket.AF_INET, ACCEPT, DROP, DROP)
    assert len(program) <= MAX_INSTRUCTIONS * INSTRUCTION_BYTES
    with closing(open_link(ALICE, port)) as alice:
        assert alice.set_peers(team)


def test_every_datagram_still_arrives_if_the_kernel_rejects_the_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    with closing(open_link(ALICE, port)) as alice, closing(open_link(BOB, port)) as bob:

        def attach(own: socket.socket, option: int, program: bytes) -> None:
            if len(program) > len(source_program((), socket.AF_INET, ACCEPT, DROP, DROP)) and own is alice._strangers:
                raise OSError(12, "Cannot allocate memory")
            source_filter.attach(own, option, program)

        monkeypatch.setattr("udp_mesh.links.udp.attach", attach)
        assert not alice.set_peers(frozenset({(BOB, port)}))
        bob.send([Out(b"bob", (ALICE, port))])
        assert arrivals(alice, 1) == ([], [b"bob"])


def test_a_kernel_without_socket_filters_still_receives_every_datagram(monkeypatch: pytest.MonkeyPatch) -> None:
    def attach(own: socket.socket, option: int, program: bytes) -> None:
        raise OSError(92, "Protocol not available")

    monkeypatch.setattr("udp_mesh.links.udp.attach", attach)
    port = free_port()
    with closing(open_link(ALICE, port)) as alice, closing(open_link(BOB, port)) as bob:
        assert not alice.set_peers(frozenset({(BOB, port)}))
        for number in range(50):
            assert bob.send([Out(b"%d" % number, (ALICE, port))]) == 1
        from_peers, from_strangers = arrivals(alice, 50)
        assert len(from_peers) + len(from_strangers) == 50


def test_a_port_in_use_is_refused_although_sockets_may_share_it() -> None:
    port = free_port()
    with closing(open_link(ALICE, port)), pytest.raises(OSError, match="in use"):
        open_link(ALICE, port)
