"""An existing device -> the inventory entries that describe it. Pure.

In an inventory, the device takes the hardware profile of its board and the mesh of its SSID, and gets new ones where
the inventory has none. Without an inventory, everything that a fleet needs comes from the device.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import PurePath

from meshctl.errors import InputError
from meshctl.interchange.device import ExistingDevice
from meshctl.interchange.hardware_entry import hardware_entry, known_profile, profile_name
from meshctl.interchange.interfaces import interfaces, routed_port, static_address, wired_ports
from meshctl.interchange.mesh_entry import mesh_entry
from meshctl.interchange.wireless import ExistingRadio, existing_radios, mesh_id, unsupported_radios
from meshctl.inventory.fields import is_name
from meshctl.inventory.yaml_text import Value
from meshctl.model import Fleet, HardwareProfile, Mesh, Secret
from meshctl.model.ip import IpInterface
from meshctl.render.rendered import LINKS_PATH
from meshctl.uci import Section

Path = tuple[str, ...]
NAME_CHARACTERS = re.compile("[^A-Za-z0-9._-]+")


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """The operator's statements about the device. `secret_file` gives the path, as the inventory writes it, of the file
    for the key of the mesh of that name."""

    name: str = ""
    address: IpInterface | None = None
    hardware: str = ""
    role: str = ""
    state: str = ""
    label: str = ""
    groups: tuple[str, ...] = ()
    fleet: str = ""
    country: str = ""
    operator_key: str = ""
    host_key: str = ""
    secret_file: Callable[[str], str] = lambda mesh: f"../{mesh}.key"


@dataclass(frozen=True, slots=True)
class Entries:
    """Values to set in the inventory, by path in the document's order. `secrets` are the keys for new files, by the
    path that `values` has; `assumed` are values that the device does not know; `sections` are the names under which
    meshctl renders the device's sections: (package, name) -> name."""

    name: str
    values: Mapping[Path, Value]
    secrets: Mapping[str, Secret] = field(default_factory=dict, repr=False)
    assumed: tuple[str, ...] = ()
    sections: Mapping[tuple[str, str], str] = field(default_factory=dict)


@dataclass(slots=True)
class _Draft:
    device: ExistingDevice
    options: ImportOptions
    fleet: Fleet | None
    values: dict[Path, Value] = field(default_factory=dict)
    secrets: dict[str, Secret] = field(default_factory=dict)
    assumed: list[str] = field(default_factory=list)
    sections: dict[tuple[str, str], str] = field(default_factory=dict)


def entries_of(device: ExistingDevice, fleet: Fleet | None, options: ImportOptions) -> Entries:
    """The entries for `device` in the inventory of `fleet`, or in a new one (None).

    Raises InputError for a name that is taken, an address that the device does not have, or a board without a radio.
    """
    draft = _Draft(device, options, fleet)
    name = _node_name(device, fleet, options)
    radios = tuple(existing_radios(device))
    if fleet is None:
        _fleet_sections(draft, name, radios)
    lan, backbone = interfaces(device, radios)
    address = options.address or static_address(backbone or lan)
    profile = known_profile(device, fleet, options.hardware, radios)
    hardware = profile.name if profile is not None else _new_hardware(draft, radios, lan)
    node: dict[str, Value] = {"groups": list(options.groups)} if options.groups else {}
    node["hardware"] = hardware
    meshes = _meshes(draft, radios, address, routed_port(device, radios, lan))
    is_in_mesh_network = _is_in_mesh_network(meshes, draft, address)
    node["address"] = str(address.ip) if is_in_mesh_network else str(address)
    node.update(_identity(draft, name))
    node.update(_wired(draft, profile, radios, lan, backbone))
    if radios:
        node["radios"] = {
            radio.name: _radio(radio, meshes.get(radio.name), is_stock=not meshes and fleet is not None)
            for radio in radios
            if profile is None or profile.radio(radio.name) is not None
        }
    _lan_robot(draft, name, lan, backbone)
    draft.values[("nodes", name)] = node
    draft.sections.update(_section_names(radios, lan, backbone))
    return Entries(name, draft.values, draft.secrets, tuple(draft.assumed), draft.sections)


def _node_name(device: ExistingDevice, fleet: Fleet | None, options: ImportOptions) -> str:
    name = options.name or device.marker.get("node", "") or as_name(device.hostname)
    if not is_name(name):
        raise InputError(
            f"expected a node name of letters, digits, '.', '_' and '-', found {name!r}", hint="give --name"
        )
    if fleet is not None and name in fleet.nodes:
        hint = f"give another --name, or compare the device with its entry: meshctl plan {name}"
        raise InputError(f"the inventory already has a node '{name}'; not changed", hint=hint)
    return name


def as_name(text: str) -> str:
    """The text as a name of the inventory: other characters become '-'."""
    return NAME_CHARACTERS.sub("-", text).strip("._-")[:63].rstrip("._-")


def _fleet_sections(draft: _Draft, name: str, radios: Iterable[ExistingRadio]) -> None:
    """The sections of a new inventory that are not about one node."""
    device, options = draft.device, draft.options
    countries = (radio.section.get("country") for radio in radios)
    country = options.country or next(filter(None, countries), "")
    if not re.fullmatch("[A-Z]{2}", country):
        raise InputError(
            "no radio of the device has a country code, which a new inventory needs", hint="give --country, such as US"
        )
    draft.values[("meshctl",)] = 1
    draft.values[("fleet",)] = options.fleet or device.marker.get("fleet", "") or as_name(f"{name}-fleet")
    draft.values[("country",)] = country
    # a collector's key may only print links, and is no operator's
    logins = tuple(key for key in device.authorized_keys if LINKS_PATH not in key)
    keys = logins or ((options.operator_key,) if options.operator_key else ())
    operators: dict[str, Value] = {"ssh_keys": list(keys)}
    section = next(device.package("dropbear").of_type("dropbear"), Section("dropbear"))
    # stock OpenWrt allows passwords; meshctl's own choice is one only on its nodes, or without a key to log in with
    if (device.marker or not keys) and section.get("RootPasswordAuth", "on") in ("on", "1"):
        operators["password_login"] = True
        if not keys:
            draft.assumed.append("operators.password_login: true, because the device has no authorized key")
    draft.values[("operators",)] = operators
    system = next(device.package("system").of_type("system"), Section("system"))
    servers = device.package("system").section("ntp")
    uses_ntp = servers is not None and servers.get("enabled", "1") == "1"
    settings: dict[str, Value] = {
        "timezone": system.get("timezone", "UTC"),
        "zonename": system.get("zonename"),
        "log_host": system.get("log_ip"),
        "ntp_servers": list(servers.items("server")) if servers is not None and uses_ntp else [],
    }
    for key, option, default in (("log_size_kib", "log_size", "64"), ("log_port", "log_port", "514")):
        if system.get(option, default) != default and system.get(option).isdecimal():
            settings[key] = int(system.get(option))
    draft.values[("system",)] = {key: value for key, value in settings.items() if value or key == "zonename"}


def _meshes(draft: _Draft, radios: Iterable[ExistingRadio], address: IpInterface, port: str) -> dict[str, str]:
    """Radio -> the mesh that its interface is in; new meshes are added to the draft."""
    joined: dict[str, str] = {}
    known: dict[str, Mapping[str, Value]] = {}
    for radio in radios:
        if radio.interface is None:
            continue
        found = _known_mesh(draft.fleet, radio)
        if found is not None:
            joined[radio.name] = found.name
            continue
        taken = {*known, *(draft.fleet.meshes if draft.fleet is not None else ())}
        base = as_name(mesh_id(radio.interface)) or "mesh"
        name = next(word for word in (base, *(f"{base}-{number}" for number in range(2, 99))) if word not in taken)
        entry, key, assumed = mesh_entry(draft.device, radio, address.network, port)
        if key is not None:
            path = draft.options.secret_file(name)
            draft.secrets[path] = key
            entry["key"] = {"file": path}
        same = next((other for other, values in known.items() if values == {**entry, **_key(values)}), None)
        joined[radio.name] = same or name
        if same is None:
            known[name] = entry
            draft.values[("meshes", name)] = entry
            draft.assumed += [f"meshes.{name}.{text}" for text in assumed]
        else:
            draft.secrets.pop(draft.options.secret_file(name), None)
    return joined


def _key(values: Mapping[str, Value]) -> Mapping[str, Value]:
    return {"key": values["key"]} if "key" in values else {}


def _known_mesh(fleet: Fleet | None, radio: ExistingRadio) -> Mesh | None:
    """The inventory's mesh of the radio's cell: same mode, SSID and band, most alike in channel and BSSID."""
    interface = radio.interface
    if fleet is None or interface is None:
        return None
    alike = [
        mesh
        for mesh in fleet.meshes.values()
        if (mesh.mode.value, mesh.ssid, mesh.band) == (interface.get("mode"), mesh_id(interface), radio.band)
    ]
    cell = (radio.section.get("channel"), interface.get("bssid").lower())
    return max(alike, key=lambda mesh: (str(mesh.channel) == cell[0]) + (mesh.bssid == cell[1]), default=None)


def _is_in_mesh_network(meshes: Mapping[str, str], draft: _Draft, address: IpInterface) -> bool:
    """Whether the prefix length of the address follows from a mesh, so that the entry needs none."""
    new = (value for path, value in draft.values.items() if path[0] == "meshes")
    networks = [str(value["network"]) for value in new if isinstance(value, Mapping)]
    if draft.fleet is not None:
        joined = set(meshes.values()) or set(draft.fleet.meshes)
        networks += [str(mesh.network) for mesh in draft.fleet.meshes.values() if mesh.name in joined]
    return str(address.network) in networks


def _identity(draft: _Draft, name: str) -> dict[str, Value]:
    """The device's identity, and the operator's choices for it."""
    device, options, fleet = draft.device, draft.options, draft.fleet
    section = next(device.package("system").of_type("system"), Section("system"))
    label = options.label or section.get("description")
    mac = device.label_mac
    if fleet is not None:
        for node in fleet.nodes.values():
            if mac and node.mac == mac:
                hint = f"remove its entry first, or compare the device with it: meshctl plan {node.name}"
                raise InputError(f"node '{node.name}' of the inventory has this device's MAC {mac}", hint=hint)
    found: dict[str, Value] = {
        "role": options.role,
        "state": options.state,
        "hostname": device.hostname if device.hostname != name and is_name(device.hostname) else "",
        "label": label,
        "mac": mac,
        "host_keys": [options.host_key] if options.host_key else [],
    }
    return {key: value for key, value in found.items() if value}


def _new_hardware(draft: _Draft, radios: tuple[ExistingRadio, ...], lan: Section) -> str:
    """Add a profile for the device's board. Raises InputError without a board name."""
    name = as_name(profile_name(draft.device))
    if not name:
        raise InputError("the device reports no board name", hint="give --hardware, a profile of the inventory")
    entry, assumed = hardware_entry(draft.device, radios, lan)
    draft.values[("hardware", name)] = entry
    draft.assumed += [f"hardware.{name}.{text}" for text in assumed]
    left_out = unsupported_radios(draft.device)
    draft.assumed += [f"hardware.{name}: without {radio}, whose band or path is not known" for radio in left_out]
    return name


def _wired(
    draft: _Draft,
    profile: HardwareProfile | None,
    radios: tuple[ExistingRadio, ...],
    lan: Section,
    backbone: Section | None,
) -> dict[str, Value]:
    """The node's values beyond its hardware profile: release, ports, gateway, SSH port."""
    device = draft.device
    found: dict[str, Value] = {}
    if profile is not None and draft.fleet is not None:
        if profile.release is not device.release:
            found["release"] = device.release.value
        added = {mesh.operator_parts.interface for mesh in draft.fleet.meshes.values()}
        ports = tuple(port for port in wired_ports(device, radios, lan) if port not in added)
        if ports and ports != profile.lan_ports:
            found["lan_ports"] = list(ports)
    gateways = [section.get(option) for section in (backbone, lan) if section for option in ("gateway", "ip6gw")]
    gateway = next(filter(None, gateways), "")
    if gateway and _is_address(gateway):
        found["gateway"] = gateway
    port = next((section.get("Port") for section in device.package("dropbear").of_type("dropbear")), "")
    if port.isdecimal() and port != "22":
        found["ssh"] = {"port": int(port)}
    return found


def _is_address(text: str) -> bool:
    try:
        ip_address(text)
    except ValueError:
        return False
    return True


def _radio(radio: ExistingRadio, mesh: str | None, *, is_stock: bool) -> dict[str, Value]:
    """A radio's settings. A stock device joins the mesh that the inventory gives it."""
    found: dict[str, Value] = {} if mesh is None and is_stock else {"mesh": mesh}
    if radio.tx_power_dbm is not None:
        found["tx_power_dbm"] = radio.tx_power_dbm
    return found


def _lan_robot(draft: _Draft, name: str, lan: Section, backbone: Section | None) -> None:
    """A new inventory gets the robot whose LAN a router routes."""
    if backbone is None or draft.fleet is not None:
        return
    inner = static_address(lan)
    draft.values[("robots", f"{name}-robot"[:63])] = {
        "nodes": [name],
        "lan": {"network": str(inner.network), "addresses": {name: str(inner.ip)}},
    }


def _section_names(
    radios: Iterable[ExistingRadio], lan: Section, backbone: Section | None
) -> dict[tuple[str, str], str]:
    """The device's sections -> the names under which meshctl renders them."""
    names: dict[tuple[str, str], str] = {("network", lan.name or ""): "lan"}
    if backbone is not None:
        names["network", backbone.name or ""] = "backbone"
    masters: dict[str, str] = {}
    joined = 0
    for radio in radios:
        if radio.interface is None:
            continue
        names["wireless", radio.interface.name or ""] = f"mesh{joined}"
        if radio.hardif is not None:
            names["network", radio.hardif.name or ""] = f"mesh{joined}"
        if radio.batman is not None and radio.batman.name is not None:
            names["network", radio.batman.name] = masters.setdefault(radio.batman.name, f"bat{len(masters)}")
        joined += 1
    return names


def secret_path(inventory: PurePath, mesh: str) -> str:
    """Where the key of a new mesh goes, relative to the inventory's file: beside its directory, so that the directory
    can be a repository."""
    return f"../{inventory.name or 'fleet'}-{mesh}.key"
