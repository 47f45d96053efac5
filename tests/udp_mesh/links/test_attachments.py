"""Which attachments a node uses: a function of the kernel's interfaces and the operator's wishes."""

import pytest

from udp_mesh.links.attachments import EVERY_INTERFACE, Attachment, LinkWish, choose
from udp_mesh.links.netlink import Interface, InterfaceAddress, NetlinkError, parse, split_messages

LO = Interface("lo", 1, 65_536, True, True, False, (InterfaceAddress("127.0.0.1", 8, None),))
BAT0 = Interface(
    "bat0",
    2,
    1500,
    True,
    False,
    True,
    (InterfaceAddress("fe80::1", 64, None), InterfaceAddress("10.7.20.5", 20, "10.7.31.255")),
)
WLAN0 = Interface("wlan0", 3, 1500, True, False, True, (InterfaceAddress("192.168.1.20", 28, "192.168.1.31"),))
WLAN1 = Interface("wlan1", 4, 1500, False, False, True, (InterfaceAddress("192.168.2.20", 24, "192.168.2.255"),))
TUN0 = Interface("tun0", 5, 1400, True, False, False, (InterfaceAddress("10.9.0.2", 32, None),))
ALL = (LO, BAT0, WLAN0, WLAN1, TUN0)


def names(*wishes: LinkWish) -> list[str]:
    return [attachment.name for attachment in choose(ALL, wishes, 8700)]


def test_by_default_every_running_interface_that_can_broadcast_is_used() -> None:
    assert choose(ALL, EVERY_INTERFACE, 8700) == (
        Attachment("bat0", "bat0", ("10.7.20.5", 8700), ("10.7.31.255", 8700), 1500),
        Attachment("wlan0", "wlan0", ("192.168.1.20", 8700), ("192.168.1.31", 8700), 1500),
    )


def test_defect_6_broadcast_addresses_are_right_for_netmasks_within_an_octet() -> None:
    found = {attachment.name: attachment.broadcast for attachment in choose(ALL, EVERY_INTERFACE, 8700)}
    assert found == {"bat0": ("10.7.31.255", 8700), "wlan0": ("192.168.1.31", 8700)}


@pytest.mark.parametrize(
    ("wish", "expected"),
    [
        (LinkWish("wlan*"), ["wlan0"]),
        (LinkWish("tun0"), []),
        (LinkWish("tun0", broadcast=False), ["tun0"]),
        (LinkWish("lo", broadcast=False), ["lo"]),
        (LinkWish("*", broadcast=False), ["bat0", "wlan0", "tun0"]),
        (LinkWish(address="10.7.20.5"), ["10.7.20.5"]),
        (LinkWish(address="127.0.0.77", broadcast=False), ["127.0.0.77"]),
        (LinkWish(address="10.7.20.6"), []),
    ],
)
def test_a_wish_is_met_by_the_interfaces_that_fit(wish: LinkWish, expected: list[str]) -> None:
    assert names(wish) == expected


def test_the_first_wish_that_fits_an_interface_wins() -> None:
    (bat0, wlan0) = choose(ALL, (LinkWish("bat0", broadcast=False, mtu=1300), LinkWish("*")), 8700)
    assert (bat0.name, bat0.broadcast, bat0.mtu) == ("bat0", None, 1300)
    assert (wlan0.name, wlan0.broadcast) == ("wlan0", ("192.168.1.31", 8700))


def test_a_wished_mtu_never_exceeds_the_interface() -> None:
    assert [attachment.mtu for attachment in choose(ALL, (LinkWish("bat0", mtu=9000),), 8700)] == [1500]


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


def test_the_kernels_messages_are_read() -> None:
    link = bytes.fromhex("34000000" + "1000" + "0200" + "01000000" + "00000000")
    link += bytes.fromhex("0000" + "0100" + "07000000" + "43100100" + "00000000")
    link += bytes.fromhex("0a000300") + b"mesh0\0\0\0" + bytes.fromhex("08000400" + "b4050000")
    assert parse(link + bytes.fromhex(ADDRESS)) == (
        Interface("mesh0", 7, 1460, True, False, True, (InterfaceAddress("10.1.2.3", 20, "10.1.15.255"),)),
    )


@pytest.mark.parametrize("cut", range(1, 48))
def test_a_message_cut_short_is_an_error_not_a_guess(cut: int) -> None:
    with pytest.raises(NetlinkError):
        list(split_messages(bytes.fromhex(ADDRESS)[:cut]))
