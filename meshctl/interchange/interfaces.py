"""A device's network sections: the management interface, its address, the wired ports. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from ipaddress import ip_interface

from meshctl.errors import InputError
from meshctl.interchange.device import ExistingDevice
from meshctl.interchange.wireless import ExistingRadio, is_meshmerize
from meshctl.model.ip import IpInterface
from meshctl.uci import Package, Section


def interfaces(device: ExistingDevice, radios: Iterable[ExistingRadio]) -> tuple[Section, Section | None]:
    """The interface of the wired ports, and the one of a router on the mesh, None on a device that bridges.

    Raises InputError for a device without an interface but the loopback.
    """
    network = device.package("network")
    masters = {radio.batman.name for radio in radios if radio.batman is not None}
    backbone: Section | None = None
    bridging: Section | None = None
    for section in network.of_type("interface"):
        if section.get("proto").startswith("batadv") or section.name == "loopback":
            continue
        direct = {*section.get("device").split(), *section.get("ifname").split()}
        if direct & masters and section.get("type") != "bridge":
            backbone = section
        elif masters & set(bridge_ports(network, section)):
            bridging = section
    static = (s for s in network.of_type("interface") if s.get("proto") == "static" and s.name != "loopback")
    lan = bridging or network.section("lan") or next(static, None)
    if lan is None and backbone is None:
        raise InputError("the device's network configuration has no interface but the loopback")
    return lan or Section("interface", "lan"), backbone


def bridge_ports(network: Package, interface: Section) -> tuple[str, ...]:
    """The ports of the interface's bridge, or of its VLAN there (`br-lan.1`), or its own device."""
    device = interface.get("device") or interface.get("ifname")
    if interface.get("type") == "bridge":
        return tuple(interface.get("ifname").split())
    bridge, _, vlan = device.rpartition(".")
    for section in network.of_type("bridge-vlan"):
        if (section.get("device"), section.get("vlan")) == (bridge, vlan):
            return tuple(_vlan_port(word, vlan) for item in section.items("ports") for word in item.split())
    for section in network.of_type("device"):
        if section.get("name") == device and section.get("type") == "bridge":
            return tuple(word for item in (section.items("ports") or section.items("ifname")) for word in item.split())
    return tuple(device.split())


def _vlan_port(member: str, vlan: str) -> str:
    """A member of a bridge's VLAN (`lan1:u*`, `lan3:t`) as a port of a bridge without VLANs."""
    port, _, flags = member.partition(":")
    return f"{port}.{vlan}" if "t" in flags else port


def static_address(interface: Section) -> IpInterface:
    """The interface's first static address. Raises InputError without one."""
    words = [word for option in ("ipaddr", "ip6addr") for item in interface.items(option) for word in item.split()]
    for word in words:
        text = word if "/" in word or ":" in word else f"{word}/{interface.get('netmask') or '32'}"
        try:
            return ip_interface(text)
        except ValueError:
            continue
    found = f"protocol '{interface.get('proto') or 'none'}'"
    raise InputError(
        f"interface '{interface.name}' has no static address, which a node needs; found {found}",
        hint="give --address, such as 10.42.0.20/24",
    )


def wired_ports(device: ExistingDevice, radios: Iterable[ExistingRadio], lan: Section) -> tuple[str, ...]:
    """The ports of the LAN's bridge without the mesh, or the board's."""
    network = device.package("network")
    known = tuple(radios)
    virtual = {*(name for radio in known for name in _mesh_devices(radio)), routed_port(device, known, lan)}
    ports = tuple(port for port in bridge_ports(network, lan) if port not in virtual)
    return ports if network.sections else device.lan_ports


def routed_port(device: ExistingDevice, radios: Iterable[ExistingRadio], lan: Section) -> str:
    """The interface of meshmerize in the LAN's bridge, empty without one: a port that the board does not have."""
    ours = [radio for radio in radios if is_meshmerize(device, radio)]
    ports = bridge_ports(device.package("network"), lan) if ours else ()
    own = {name for radio in ours for name in _mesh_devices(radio)}
    return next((port for port in ports if port in own or (device.lan_ports and port not in device.lan_ports)), "")


def _mesh_devices(radio: ExistingRadio) -> Iterator[str]:
    if radio.interface is not None:
        yield radio.interface.get("ifname") or radio.interface.name or ""
    if radio.batman is not None:
        yield radio.batman.name or ""
