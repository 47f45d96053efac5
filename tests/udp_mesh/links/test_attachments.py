"""Which attachments a node uses: a function of the kernel's interfaces and the operator's configs."""

import socket
import struct
from dataclasses import replace

import pytest

from udp_mesh.links.attachments import ALL_NODES, EVERY_INTERFACE, Attachment, LinkConfig, select_attachments
from udp_mesh.links.netlink import Interface, InterfaceAddress, NetlinkError, parse, split_messages

LO = Interface("lo", 1, 65_536, True, True, False, False, (InterfaceAddress("127.0.0.1", 8, None),))
BAT0 = Interface(
    "bat0",
    2,
    1500,
    True,
    False,
    True,
    True,
    (InterfaceAddress("fe80::1", 64, None), InterfaceAddress("10.7.20.5", 20, "10.7.31.255")),
)
WLAN0 = Interface("wlan0", 3, 1500, True, False, True, True, (InterfaceAddress("192.168.1.20", 28, "192.168.1.31"),))
WLAN1 = Interface("wlan1", 4, 1500, False, False, True, True, (InterfaceAddress("192.168.2.20", 24, "192.168.2.255"),))
TUN0 = Interface("tun0", 5, 1400, True, False, False, False, (InterfaceAddress("10.9.0.2", 32, None),))
ALL = (LO, BAT0, WLAN0, WLAN1, TUN0)


def names(*configs: LinkConfig) -> list[str]:
    return [attachment.name for attachment in select_attachments(ALL, configs, 8700)]


def test_by_default_every_running_interface_that_can_broadcast_is_used() -> None:
    assert select_attachments(ALL, EVERY_INTERFACE, 8700) == (
        Attachment("bat0", "bat0", ("10.7.20.5", 8700), ("10.7.31.255", 8700), 1500, 2),
        Attachment("wlan0", "wlan0", ("192.168.1.20", 8700), ("192.168.1.31", 8700), 1500, 3),
    )


def test_a_recreated_interface_is_a_different_attachment() -> None:
    (before,) = select_attachments((WLAN0,), EVERY_INTERFACE, 8700)
    (after,) = select_attachments((replace(WLAN0, index=9),), EVERY_INTERFACE, 8700)
    assert before != after


def test_defect_6_broadcast_addresses_are_right_for_netmasks_within_an_octet() -> None:
    found = {attachment.name: attachment.broadcast for attachment in select_attachments(ALL, EVERY_INTERFACE, 8700)}
    assert found == {"bat0": ("10.7.31.255", 8700), "wlan0": ("192.168.1.31", 8700)}


@pytest.mark.parametrize(
    ("wish", "expected"),
    [
        (LinkConfig("wlan*"), ["wlan0"]),
        (LinkConfig("tun0"), []),
        (LinkConfig("tun0", broadcast=False), ["tun0"]),
        (LinkConfig("lo", broadcast=False), ["lo"]),
        (LinkConfig("*", broadcast=False), ["bat0", "wlan0", "tun0"]),
        (LinkConfig(address="10.7.20.5"), ["10.7.20.5"]),
        (LinkConfig(address="127.0.0.77", broadcast=False), ["127.0.0.77"]),
        (LinkConfig(address="10.7.20.6"), []),
    ],
)
def test_a_link_config_selects_the_matching_interfaces(wish: LinkConfig, expected: list[str]) -> None:
    assert names(wish) == expected


def test_the_first_link_config_matching_an_interface_wins() -> None:
    (bat0, wlan0) = select_attachments(ALL, (LinkConfig("bat0", broadcast=False, mtu=1300), LinkConfig("*")), 8700)
    assert (bat0.name, bat0.broadcast, bat0.mtu) == ("bat0", None, 1300)
    assert (wlan0.name, wlan0.broadcast) == ("wlan0", ("192.168.1.31", 8700))


def test_a_configured_mtu_never_exceeds_the_interface_mtu() -> None:
    assert [attachment.mtu for attachment in select_attachments(ALL, (LinkConfig("bat0", mtu=9000),), 8700)] == [1500]


# RTM_NEWADDR: 10.1.2.3/20 on interface 7.
ADDRESS = (
    "30000000140002000100000000000000"
    + "0214800007000000"
    + "08000100"
    + "0a010203"
    + "08000200"
    + "0a010203"
    + "08000400"
    + "0a010fff"
)


def test_netlink_messages_are_parsed() -> None:
    link = bytes.fromhex("34000000" + "1000" + "0200" + "01000000" + "00000000")
    link += bytes.fromhex("0000" + "0100" + "07000000" + "43100100" + "00000000")
    link += bytes.fromhex("0a000300") + b"mesh0\0\0\0" + bytes.fromhex("08000400" + "b4050000")
    assert parse(link + bytes.fromhex(ADDRESS)) == (
        Interface("mesh0", 7, 1460, True, False, True, True, (InterfaceAddress("10.1.2.3", 20, "10.1.15.255"),)),
    )


@pytest.mark.parametrize("cut", range(1, 48))
def test_a_truncated_netlink_message_is_an_error(cut: int) -> None:
    with pytest.raises(NetlinkError):
        list(split_messages(bytes.fromhex(ADDRESS)[:cut]))


@pytest.mark.parametrize(
    ("address", "prefix_length", "broadcast"),
    [("10.7.20.5", 20, "10.7.31.255"), ("192.168.1.20", 28, "192.168.1.31"), ("10.0.0.1", 31, None)],
)
def test_a_missing_broadcast_address_is_derived_from_the_prefix(
    address: str, prefix_length: int, broadcast: str | None
) -> None:
    local = socket.inet_aton(address)

    def answers(far_end: bytes) -> bytes:
        link = struct.pack("=BxHiII", 0, 1, 7, 0x1 | 0x2 | 0x40, 0) + struct.pack("=HH8s", 10, 3, b"wlan0\0\0\0")
        body = struct.pack("=BBBBI", socket.AF_INET, prefix_length, 0x80, 0, 7)
        body += struct.pack("=HH4s", 8, 1, far_end) + struct.pack("=HH4s", 8, 2, local)
        return b"".join(
            struct.pack("=IHHII", 16 + len(body), kind, 0, 1, 0) + body for kind, body in ((16, link), (20, body))
        )

    assert parse(answers(local))[0].addresses == (InterfaceAddress(address, prefix_length, broadcast),)
    # a point-to-point address has a remote end, not a network
    assert parse(answers(socket.inet_aton("10.9.9.9")))[0].addresses[0].broadcast is None


WLAN6 = Interface(
    "wlan6", 6, 1500, True, False, True, True,
    (InterfaceAddress("2001:db8::6", 64, None), InterfaceAddress("fe80::6", 64, None)),
)  # fmt: skip


def test_ipv6_all_nodes_multicast_is_used_without_an_ipv4_broadcast_address() -> None:
    expected = Attachment("wlan6", "wlan6", ("fe80::6", 8700), (ALL_NODES, 8700), 1500, 6)
    assert select_attachments((LO, WLAN6), EVERY_INTERFACE, 8700) == (expected,)
    # an interface with both is used with IPv4, as ever
    both = replace(WLAN6, addresses=(*WLAN6.addresses, *WLAN0.addresses))
    assert select_attachments((both,), EVERY_INTERFACE, 8700)[0].broadcast == ("192.168.1.31", 8700)
    # without multicast (a tunnel) neighbours must be named
    assert select_attachments((replace(WLAN6, can_multicast=False),), EVERY_INTERFACE, 8700) == ()


def test_fixed_ipv6_neighbors_are_reached_from_the_routable_address() -> None:
    (found,) = select_attachments((WLAN6,), (LinkConfig("wlan6", broadcast=False),), 8700)
    assert (found.address, found.broadcast) == (("2001:db8::6", 8700), None)


def test_a_configured_ipv6_address_broadcasts_to_all_nodes_on_its_link() -> None:
    (found,) = select_attachments((LO, WLAN6), (LinkConfig(address="2001:db8::6"),), 8700)
    assert (found.device, found.broadcast) == ("wlan6", (ALL_NODES, 8700))
    assert select_attachments((LO, WLAN6), (LinkConfig(address="::1"),), 8700) == ()


def test_tentative_and_duplicate_ipv6_addresses_are_not_used() -> None:
    def answers(flags: int) -> bytes:
        link = struct.pack("=BxHiII", 0, 1, 6, 0x1 | 0x40 | 0x1000, 0) + struct.pack("=HH8s", 10, 3, b"wlan6\0\0\0")
        address = struct.pack("=BBBBI", socket.AF_INET6, 64, flags, 253, 6)
        address += struct.pack("=HH16s", 20, 1, socket.inet_pton(socket.AF_INET6, "fe80::6"))
        return b"".join(
            struct.pack("=IHHII", 16 + len(body), kind, 0, 1, 0) + body for kind, body in ((16, link), (20, address))
        )

    assert [one.host for one in parse(answers(0))[0].addresses] == ["fe80::6"]
    for flags in (0x40, 0x08, 0x48):
        assert parse(answers(flags))[0].addresses == ()
