"""Health checks after a change: observations before and after it -> the conditions not met yet. Pure.

A change is confirmed only when its services have reloaded (`_reload`), packages are installed (`_packages`), the LAN is
up (`_lan`), radios have joined their cells (`_radios`) and are part of batman-adv (`_batman`), those turned off have
left theirs (`_off`), enough mesh neighbors are heard (`_neighbors`) and the base is reachable (`_base`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from ipaddress import ip_address

from meshctl.device.observation import Observation, WirelessLink
from meshctl.plan import DesiredState
from meshctl.plan.abilities import IW_MODES
from meshctl.plan.cell import enabled_interfaces
from meshctl.plan.left_over import interface_names, left_over
from meshctl.plan.observed_files import WIRELESS, address_options, packages_seen
from meshctl.plan.packages import NO_NEEDS, Needs, missing_packages
from meshctl.topology import NEIGHBOR_FRESH_MS
from meshctl.uci import Package, Section
from meshctl.wording import counted

# The share of its former neighbors a node must hear again; not all, because robots move.
MIN_NEIGHBOR_SHARE = 0.5
RELOADING = "its services are still reloading"
NEEDS_LONGER_WINDOW = "it needs a longer confirm_window_s"
# scripts/reload.sh: the window was about to end
_RELOAD_WAS_LATE = 75
# netifd, proto.c (proto_attach_interface): a protocol without a handler
_UNKNOWN_PROTOCOL = "INVALID_PROTO"


@dataclass(frozen=True, slots=True)
class Expectation:
    """Conditions after the change. `neighbors` are the MACs heard before, `base_macs` the MACs of the base's mesh
    radios, both empty on the bench; `off` are radio interfaces that the change turns off; `needs` are packages, for a
    change of packages."""

    wireless: Package | None = None
    network: Package | None = None
    neighbors: frozenset[str] = frozenset()
    base_macs: frozenset[str] = frozenset()
    off: frozenset[str] = frozenset()
    needs: Needs = NO_NEEDS

    def with_base_macs(self, current: frozenset[str]) -> Expectation:
        """The same, with further MACs of the base; a node that did not reach the base before need not now."""
        return replace(self, base_macs=self.base_macs | current) if self.base_macs else self


def expectation(desired: DesiredState, before: Observation, base_macs: Iterable[str] = ()) -> Expectation:
    """Conditions for this node after the change; the base only if it was reachable through the mesh before."""
    trees = {file.package.name: file.package for file in desired.files if file.package is not None}
    originators = {entry.mac.lower() for entry in before.originators or ()}
    wireless = trees.get("wireless")
    off = frozenset(left_over(before))
    if wireless is not None:
        named_before = interface_names(packages_seen([WIRELESS], before)["wireless"]) - {""}
        off = (off | named_before) - interface_names(wireless)
    return Expectation(
        wireless,
        trees.get("network"),
        # nodes that only a radio heard that is off now are not heard again
        heard_neighbors(replace(before, neighbors=tuple(n for n in before.neighbors or () if n.ifname not in off))),
        frozenset(mac.lower() for mac in base_macs) & originators,
        off,
    )


def heard_neighbors(observation: Observation, fresh_ms: float = NEIGHBOR_FRESH_MS) -> frozenset[str]:
    """The MACs of the mesh neighbors heard recently."""
    return frozenset(n.mac.lower() for n in observation.neighbors or () if n.last_seen_ms <= fresh_ms)


def unmet(expected: Expectation, after: Observation, *, since_s: float | None = None) -> tuple[str, ...]:
    """The conditions not met yet, one clause each; empty when the change has proven itself.

    `since_s` is how long the change has been applied: what was heard before does not count.
    """
    fresh_ms = NEIGHBOR_FRESH_MS if since_s is None else min(NEIGHBOR_FRESH_MS, since_s * 1000)
    return (
        *_reload(after),
        *_packages(expected, after),
        *_lan(expected, after),
        *_radios(expected, after),
        *_off(expected, after),
        *_batman(expected, after),
        *_neighbors(expected, after, fresh_ms),
        *_base(expected, after, fresh_ms),
    )


def _reload(after: Observation) -> tuple[str, ...]:
    if after.change is None or after.change.state != "applied":
        return ()
    status = after.change.reload_status
    if status is None:
        return (RELOADING,)
    if status == _RELOAD_WAS_LATE:
        return (f"its services had not reloaded within the confirm window: {NEEDS_LONGER_WINDOW}",)
    return (f"reloading its services failed with exit status {status}",) if status != 0 else ()


def _packages(expected: Expectation, after: Observation) -> tuple[str, ...]:
    lacking = missing_packages(expected.needs, after)
    return (f"it lacks {', '.join(group[0] for group in lacking)}",) if lacking else ()


def _lan(expected: Expectation, after: Observation) -> tuple[str, ...]:
    if expected.network is None or after.interfaces is None:
        return ()
    # a router's interface on the mesh, with the management address
    for name, what in (("lan", "its LAN"), ("backbone", "its mesh interface")):
        section = expected.network.section(name)
        if section is None:
            continue
        interface = next((found for found in after.interfaces if found.name == name), None)
        if interface is None or not interface.up:
            return (f"{what} is down",)
        present = {_canonical(found) for found in interface.addresses}
        if missing := [option for option in address_options(section) if _canonical(option) not in present]:
            return (f"{what} has {', '.join(interface.addresses) or 'no address'}, not {missing[0]}",)
    lan = expected.network.section("lan")
    return () if lan is None else _bridge(expected.network, lan.get("device"), after)


def _canonical(address: str) -> str:
    """An address without its prefix length in the one spelling of RFC 5952; other text unchanged."""
    bare = address.partition("/")[0]
    try:
        return str(ip_address(bare))
    except ValueError:
        return bare


def _bridge(network: Package | None, device: str, after: Observation) -> tuple[str, ...]:
    section = None if network is None else _device(network, device)
    bridge = next((found for found in after.bridges or () if found.name == device), None)
    if section is None or after.bridges is None:
        return ()
    absent = [port for port in section.items("ports") if bridge is None or port not in bridge.ports]
    return (f"{', '.join(absent)} not in its bridge {device}",) if absent else ()


def _device(network: Package, name: str) -> Section | None:
    return next((section for section in network.of_type("device") if section.get("name") == name), None)


def _radios(expected: Expectation, after: Observation) -> tuple[str, ...]:
    if expected.wireless is None or after.links is None:
        return ()
    problems = []
    for iface, device in enabled_interfaces(expected.wireless):
        problems += _radio(iface, device.get("channel"), after)
    return tuple(problems)


def _off(expected: Expectation, after: Observation) -> tuple[str, ...]:
    """25.12's scripts leave an interface in its cell that netifd reports as down (scripts/reload.sh, settle_radios)."""
    left = [link.ifname for link in after.links or () if link.ifname in expected.off]
    return tuple(f"{name} should be off, but still exists" for name in left)


def _radio(iface: Section, channel: str, after: Observation) -> list[str]:
    link = _link_of(iface, after)
    name = iface.get("ifname") or (link.ifname if link is not None else _described(iface))
    if link is None:
        radio = next((found for found in after.radios or () if found.name == iface.get("device")), None)
        # netifd tries no more until the next change or `wifi up`
        given_up = f": netifd gave up setting up {radio.name}" if radio is not None and radio.setup_failed else ""
        return [f"{name} does not exist{given_up}"]
    # `up` in netifd does not mean that the cell was joined (openwrt-facts.md section 5)
    if link.joined is False:
        return [f"{name} has not joined its cell"]
    # 23.05 and later join a mesh unencrypted where the supplicant cannot (wifi-scripts, mac80211.sh); access points are
    # hostapd's
    is_encrypted = iface.get("mode") != "ap" and iface.get("encryption", "none") != "none"
    if is_encrypted and after.supplicants is not None and name not in after.supplicants:
        return [f"{name} is not encrypted: wpa_supplicant does not run it"]
    if link.channel is not None and channel.isdigit() and link.channel != int(channel):
        return [f"{name} is on channel {link.channel}, not {channel}"]
    bssid = iface.get("bssid").lower()
    if bssid and link.bssid is not None and link.bssid.lower() != bssid:
        return [f"{name} is in cell {link.bssid}, not {bssid}"]
    return []


def _link_of(iface: Section, after: Observation) -> WirelessLink | None:
    """The interface of a section. OpenWrt names it itself if `ifname` is missing, as in an access point that
    `extra_uci` adds: then one of its mode, and of its SSID if iw shows one."""
    name, mode, ssid = iface.get("ifname"), iface.get("mode"), iface.get("ssid")
    links = after.links or ()
    if name:
        return next((found for found in links if found.ifname == name), None)
    return next((found for found in links if found.mode == IW_MODES.get(mode) and found.ssid in (ssid, None)), None)


def _described(iface: Section) -> str:
    """An interface without a name, by its section or SSID."""
    return f"the interface of {iface.name or iface.get('ssid') or iface.get('mode')}"


def _batman(expected: Expectation, after: Observation) -> tuple[str, ...]:
    """A node that is alone hears no neighbor anyway: without this check, it would be found deaf only in the field."""
    states = {state.name: state for state in after.interfaces or ()}
    hard = None if after.mesh is None else after.mesh.hard_interfaces
    problems = []
    for iface, _ in enabled_interfaces(expected.wireless):
        section = None if expected.network is None else expected.network.section(iface.get("network"))
        if section is None or section.get("proto") != "batadv_hardif":
            continue
        link, master = _link_of(iface, after), section.get("master")
        name = iface.get("ifname") or (link.ifname if link is not None else _described(iface))
        state = states.get(iface.get("network"))
        if state is not None and _UNKNOWN_PROTOCOL in state.errors:
            problems.append("netifd does not know batman-adv: /lib/netifd/proto/batadv_hardif.sh is missing or fails")
        elif after.macs is not None and master not in after.macs:
            problems.append(f"{master} does not exist")
        elif hard is not None and name not in hard:
            problems.append(f"{name} is not part of {master}")
    return tuple(dict.fromkeys(problems))


def _neighbors(expected: Expectation, after: Observation, fresh_ms: float) -> tuple[str, ...]:
    needed = math.ceil(len(expected.neighbors) * MIN_NEIGHBOR_SHARE)
    # by number, not by name: robots move
    found = len(heard_neighbors(after, fresh_ms))
    if found >= needed:
        return ()
    return (f"it hears {counted(found, 'mesh neighbor')} of the {len(expected.neighbors)} it had",)


def _base(expected: Expectation, after: Observation, fresh_ms: float) -> tuple[str, ...]:
    if not expected.base_macs:
        return ()
    reached = {entry.mac.lower() for entry in after.originators or () if entry.last_seen_ms <= fresh_ms}
    return () if expected.base_macs & reached else ("it has no route to the base",)
