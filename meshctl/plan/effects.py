"""The services that a configuration change reloads, and what they interrupt.

`reload_config` reloads the service of each changed package (procd's triggers). What that interrupts depends on the
changed options and the release, since netifd takes down only what differs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from meshctl.model import Release
from meshctl.plan.observed_files import address_options, management_section, package_of
from meshctl.plan.radios import RadioChange, radio_changes
from meshctl.plan.values import Cut, Effect
from meshctl.render import LAN_FILTER_PATH
from meshctl.uci import Package, Section

# Package -> (service, what its reload cuts), whatever options changed.
_RELOADS: Mapping[str, tuple[str, Cut]] = {
    "system": ("system, log", Cut.NOTHING),
    "dhcp": ("dnsmasq, odhcpd", Cut.NOTHING),
    "firewall": ("firewall", Cut.LOGIN),
    "dropbear": ("dropbear", Cut.LOGIN),
}


def effects(
    changed: Iterable[str],
    before: Mapping[str, Package | None],
    after: Mapping[str, Package | None],
    release: Release,
) -> tuple[Effect, ...]:
    """The effects of changing these files (`etc/config/network`, ...) on that release, the worst first."""
    found = [effect for path in changed for effect in _effects(path, before, after, release)]
    return tuple(sorted(found, key=lambda effect: (-effect.cut, effect.service)))


def _effects(
    path: str, before: Mapping[str, Package | None], after: Mapping[str, Package | None], release: Release
) -> list[Effect]:
    package = loaded_package(path)
    if package is None:
        # keys and markers are read on use
        return []
    if package == "network":
        return _network(before.get(package), after.get(package))
    if package == "wireless":
        return _wireless(before.get(package), after.get(package), release)
    service, cut = _RELOADS.get(package, (package, Cut.MESH))
    return [Effect(service, cut, f"{package} changes")]


def loaded_package(path: str) -> str | None:
    """The UCI package whose services read the file at `path`; None: nothing has to be reloaded."""
    return "firewall" if path == LAN_FILTER_PATH else package_of(path)


def _wireless(before: Package | None, after: Package | None, release: Release) -> list[Effect]:
    if not _has_live_radio(before):
        return [Effect("wifi", Cut.NOTHING, "radios are off")]
    if before is None or after is None:
        return [Effect("wifi", Cut.MESH, "wireless changes")]
    found = [_radio(change) for change in radio_changes(before, after, release)]
    return found or [Effect("wifi", Cut.NOTHING, "no radio changes")]


def _radio(change: RadioChange) -> Effect:
    options = ", ".join(change.options)
    down = Cut.MESH if change.has_links else Cut.LAN
    if change.restarts:
        return Effect("wifi", down, f"{change.radio} restarts: {options}")
    if change.rejoins:
        return Effect("wifi", down, f"the interfaces of {change.radio} leave their networks and return: {options}")
    if change.may_lose_range and change.has_links:
        return Effect("wifi", Cut.WEAK_LINKS, f"{change.radio}: {options} set without a restart")
    return Effect("wifi", Cut.NOTHING, f"{change.radio}: {options} set without a restart")


def _has_live_radio(wireless: Package | None) -> bool:
    devices = () if wireless is None else wireless.of_type("wifi-device")
    return any(device.get("disabled", "0") != "1" for device in devices)


def _network(before: Package | None, after: Package | None) -> list[Effect]:
    if before is None or after is None:
        return [Effect("network", Cut.MESH, "network changes")]
    old, new = _by_key(before), _by_key(after)
    differing = [key for key in {**old, **new} if old.get(key) != new.get(key)]
    was_there = [section for key in differing if (section := old.get(key)) is not None]
    found = []
    if any(section.get("proto") in ("batadv", "batadv_hardif") for section in was_there):
        # any option of bat0 destroys and recreates it (openwrt-facts.md section 1)
        found.append(Effect("network", Cut.MESH, "bat0 is recreated"))
    addresses = [_address(management_section(package)) for package in (before, after)]
    if addresses[0] != addresses[1]:
        found.append(
            Effect("network", Cut.LAN, f"its address changes from {addresses[0] or '-'} to {addresses[1] or '-'}")
        )
    if before.section("backbone") is None and after.section("backbone") is not None:
        found.append(Effect("network", Cut.LAN, "it routes its LAN, which leaves the mesh's network"))
    elif before.section("backbone") is not None and after.section("backbone") is None:
        found.append(Effect("network", Cut.LAN, "it bridges its LAN into the mesh's network"))
    if not found and {section.type for section in was_there + [new[key] for key in differing if key in new]} == {
        "route"
    }:
        # netifd replaces routes in place; a login from another robot's LAN may come over one of them
        return [Effect("network", Cut.LOGIN, "routes to the robots' LANs change")]
    return found or [Effect("network", Cut.LAN, "network changes")]


def _by_key(package: Package) -> dict[str, Section]:
    return dict(zip(package.keys(), package.sections, strict=True))


def _address(section: Section | None) -> str:
    return ", ".join(address_options(section))
