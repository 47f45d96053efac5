"""The alternate MAC addresses of a radio. Pure.

From 23.05 on a radio interface that replaces another one gets the next free address of its phy, because the old one
still exists at that time, and the first address again after a boot (hostapd: common.uc, macaddr_init). So a node that
was last seen as 04:.. may be heard as 06:.. now.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

# The bits in which a phy's addresses differ: the local bit and the one above (ath9k: 04 -> 06, 02 -> 06), or hwsim's.
_BITS = (0x02, 0x04, 0x40)
_MASKS = tuple(sum(some) for count in (1, 2, 3) for some in combinations(_BITS, count))


def alternate_macs(mac: str) -> tuple[str, ...]:
    """The other addresses of the radio with this MAC address, lower case; none if it is not a MAC address."""
    first, colon, rest = mac.lower().partition(":")
    try:
        octet = int(first, 16)
    except ValueError:
        return ()
    return tuple(f"{octet ^ mask:02x}:{rest}" for mask in _MASKS) if colon and len(first) == 2 else ()


def with_alternates(names: Mapping[str, str]) -> dict[str, str]:
    """MAC -> node, with the alternates of each MAC that are unambiguous and not another node's known MAC."""
    owners: dict[str, set[str]] = {}
    for mac, name in names.items():
        for other in alternate_macs(mac):
            owners.setdefault(other, set()).add(name)
    others = {mac: nodes.pop() for mac, nodes in owners.items() if len(nodes) == 1 and mac not in names}
    return {**names, **others}
