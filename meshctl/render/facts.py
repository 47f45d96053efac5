"""What only the device knows and its new configuration keeps: the node's own packages -> the sections carried over.

meshctl replaces a package whole, but some of what stands in it was written by the board's own scripts at its first boot
(`/etc/board.d`, `config_generate`) or at any (`wifi config`), from what no inventory holds. Without the layout of a
switch that `swconfig` drives, its ports lead nowhere after the next reboot. What the inventory writes itself is the
inventory's whole: a section of the same kind is not carried over then.

What is replaced all the same, because a mesh node lives without it: other interfaces than the rendered ones, `globals`
(an IPv6 prefix of its own), routes, DSL. firewall, dhcp and dropbear hold nothing of a board's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from meshctl.uci import Package, Section

# Kinds of sections that belong together; generate_switch, generate_led, generate_rssimon and generate_gpioswitch of
# base-files' `bin/config_generate`. A gpio_switch may feed another box (PoE passthrough).
_SWITCH = frozenset({"switch", "switch_vlan", "switch_port"})
_LIGHTS = frozenset({"led", "rssid"})
_GPIO = frozenset({"gpio_switch"})


@dataclass(frozen=True, slots=True)
class DeviceFacts:
    """`compat_version`, which sysupgrade reads, and the node's `packages` by name as they stand there."""

    compat_version: str = ""
    packages: Mapping[str, Package] = field(default_factory=lambda: MappingProxyType({}), repr=False)


NO_FACTS = DeviceFacts()


def with_switch(network: Package, vlans: Iterable[tuple[str, str, str]]) -> Package:
    """A node's own package `network` with the layout of its switches (switch, VLAN, ports), as config_generate writes
    it, where it has lost every trace of them."""
    if any(section.type in _SWITCH for section in network.sections):
        return network
    layout = tuple(vlans)
    switches = (
        Section("switch", None, {"name": name, "reset": "1", "enable_vlan": "1"})
        for name in dict.fromkeys(name for name, _, _ in layout)
    )
    members = (
        Section("switch_vlan", None, {"device": name, "vlan": vlan, "ports": ports}) for name, vlan, ports in layout
    )
    return Package(network.name, (*network.sections, *switches, *members))


def with_board_sections(package: Package, facts: DeviceFacts) -> Package:
    """The rendered package with what the node's own one has to keep, in the node's order behind the rest."""
    keep = _KEEPERS.get(package.name)
    own = facts.packages.get(package.name)
    if keep is None or own is None:
        return package
    names = {section.name for section in package.sections} - {None}
    kept = (section for section in keep(package, own) if section.name not in names)
    return Package(package.name, (*package.sections, *kept))


def _network(package: Package, own: Package) -> Iterator[Section]:
    ports = _ports(package)
    for section in own.sections:
        if _is_of(section, _SWITCH, package) or _is_port_address(section, ports):
            yield section


def _is_of(section: Section, kinds: frozenset[str], package: Package) -> bool:
    """Whether it is of these kinds, and the inventory writes none of them."""
    return section.type in kinds and not any(written.type in kinds for written in package.sections)


def _ports(package: Package) -> frozenset[str]:
    """The ports of rendered bridges that no rendered device section speaks of."""
    lists = [
        word
        for s in package.sections
        for option in ("ports", "ifname")
        for item in s.items(option)
        for word in item.split()
    ]
    return frozenset(lists) - {section.get("name") for section in package.of_type("device")}


def _is_port_address(section: Section, ports: frozenset[str]) -> bool:
    """A port's MAC address as the board's manufacturer wrote it into flash; the driver may have drawn another one."""
    return section.type == "device" and section.options.keys() == {"name", "macaddr"} and section.get("name") in ports


def _system(package: Package, own: Package) -> Iterator[Section]:
    return (s for s in own.sections if any(_is_of(s, kinds, package) for kinds in (_LIGHTS, _GPIO)))


def _wireless(package: Package, own: Package) -> Iterator[Section]:
    """Radios that the inventory leaves out, switched off: `wifi config` runs at every boot and adds what is not named.

    What it adds is left as it is, with the interface it has; of a radio that somebody switched on nothing else is kept.
    """
    radios = [section for section in package.sections if section.type == "wifi-device"]
    names, paths = {radio.name for radio in radios}, {radio.get("path") for radio in radios} - {""}
    off: set[str | None] = set()
    for section in own.sections:
        # a device with several radios has one path for all; `wifi config` misses those that do not say which they are
        is_other = section.get("path") not in paths or bool(section.get("radio"))
        if section.type == "wifi-device" and section.name not in names and is_other:
            if section.get("disabled") == "1":
                off.add(section.name)
            yield Section(section.type, section.name, {**section.options, "disabled": "1"})
        elif section.type == "wifi-iface" and section.get("device") in off:
            yield section


_KEEPERS: Mapping[str, Callable[[Package, Package], Iterator[Section]]] = MappingProxyType(
    {"network": _network, "system": _system, "wireless": _wireless}
)
