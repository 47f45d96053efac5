"""Keep board-specific sections: a node's current packages -> the sections to keep in its new configuration.

meshctl replaces whole packages, but the board's own scripts write some sections at first boot (`/etc/board.d`,
`config_generate`) or at every boot (`wifi config`) from data that is not in the inventory. Without the layout of a
swconfig switch, for example, its ports are dead after the next reboot. If the inventory defines sections of a kind,
the device's sections of that kind are not kept.

A mesh node works without the rest, which is replaced: interfaces that are not rendered, `globals` (a ULA prefix),
routes, DSL. firewall, dhcp and dropbear contain nothing board-specific.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from meshctl.uci import Package, Section

# Related section types; generate_switch, generate_led, generate_rssimon and generate_gpioswitch of
# base-files' `bin/config_generate`. A gpio_switch may feed another box (PoE passthrough).
_SWITCH = frozenset({"switch", "switch_vlan", "switch_port"})
_LIGHTS = frozenset({"led", "rssid"})
_GPIO = frozenset({"gpio_switch"})


@dataclass(frozen=True, slots=True)
class DeviceFacts:
    """`compat_version`, which sysupgrade reads, and the node's current `packages` by name."""

    compat_version: str = ""
    packages: Mapping[str, Package] = field(default_factory=lambda: MappingProxyType({}), repr=False)


NO_FACTS = DeviceFacts()


def with_switch(network: Package, vlans: Iterable[tuple[str, str, str]]) -> Package:
    """A node's current `network` package; if it has no switch sections, add `vlans` (switch, VLAN, ports) as
    config_generate writes them."""
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
    """The rendered package, followed by the sections to keep of the node's current one, in the node's order."""
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
    """Whether the section is of these kinds, and the rendered package has none of them."""
    return section.type in kinds and not any(written.type in kinds for written in package.sections)


def _ports(package: Package) -> frozenset[str]:
    """The ports of rendered bridges without a rendered device section."""
    lists = [
        word
        for s in package.sections
        for option in ("ports", "ifname")
        for item in s.items(option)
        for word in item.split()
    ]
    return frozenset(lists) - {section.get("name") for section in package.of_type("device")}


def _is_port_address(section: Section, ports: frozenset[str]) -> bool:
    """Whether the section sets a port's MAC address from flash, which the driver may not use by itself."""
    return section.type == "device" and section.options.keys() == {"name", "macaddr"} and section.get("name") in ports


def _system(package: Package, own: Package) -> Iterator[Section]:
    return (s for s in own.sections if any(_is_of(s, kinds, package) for kinds in (_LIGHTS, _GPIO)))


def _wireless(package: Package, own: Package) -> Iterator[Section]:
    """Radios that the inventory omits, disabled: `wifi config` runs at every boot and adds missing ones.

    A disabled radio keeps its interface; an enabled radio is disabled and loses its interfaces.
    """
    radios = [section for section in package.sections if section.type == "wifi-device"]
    names, paths = {radio.name for radio in radios}, {radio.get("path") for radio in radios} - {""}
    off: set[str | None] = set()
    for section in own.sections:
        # radios of one device share a path; `wifi config` identifies them by `radio`
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
