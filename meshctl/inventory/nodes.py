"""Layers -> nodes: merge values, match radios with hardware and mesh, compute addresses.

Nodes with the same layers (a range) are built once; only name, hostname and address differ.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from ipaddress import IPv4Interface, ip_interface
from pathlib import Path
from types import MappingProxyType
from typing import Any

from meshctl.diagnostics import Diagnostic
from meshctl.inventory import codes
from meshctl.inventory.addresses import AddressRule, AddressValue, BadAddress
from meshctl.inventory.documents import LanFilterLayer, PositionDocument, RadioLayer, SshLayer
from meshctl.inventory.file_paths import from_inventory
from meshctl.inventory.layers import Layer, NodeSpec
from meshctl.inventory.tree import Tree, child
from meshctl.model import (
    Band,
    FixedPosition,
    HardwareProfile,
    LanFilter,
    Mesh,
    Node,
    NodeState,
    Radio,
    Role,
    SshSettings,
)
from meshctl.model.ip import IpAddress, IpInterface, IpNetwork
from meshctl.suggest import did_you_mean

# comparing names is quadratic in their number
_MAX_COMPARED = 1000
# Placeholder in a template until the node's address is known.
_NO_ADDRESS = IPv4Interface("0.0.0.0/0")


@dataclass(frozen=True, slots=True)
class BuiltNodes:
    nodes: dict[str, Node]
    diagnostics: tuple[Diagnostic, ...]


@dataclass(frozen=True, slots=True)
class _Template:
    """The shared part of all nodes with the same layers."""

    node: Node
    address: AddressValue
    address_layer: Layer
    hostname: str
    network: IpNetwork | None


def build_nodes(
    specs: Mapping[str, NodeSpec],
    hardware: Mapping[str, HardwareProfile],
    meshes: Mapping[str, Mesh],
    robot_of: Mapping[str, str],
    lan_addresses: Mapping[str, IpInterface],
    base: str,
) -> BuiltNodes:
    """Build all nodes; errors of a range are reported once.

    `robot_of` maps nodes to the robots that list them, for nodes without `robot`; `lan_addresses` maps the radios of
    robots with a LAN of their own to their addresses in it; `base` is the inventory's directory.
    """
    building = _Building(hardware, meshes, _only_meshes(meshes), base, _complete(specs))
    nodes: dict[str, Node] = {}
    for spec in specs.values():
        node = building.node(spec, robot_of.get(spec.name, ""))
        if node is not None:
            lan_address = lan_addresses.get(spec.name)
            nodes[spec.name] = node if lan_address is None else replace(node, lan_address=lan_address)
    return BuiltNodes(nodes, tuple(building.diagnostics))


def merge_layers(layers: tuple[Layer, ...], base: str) -> dict[str, Any]:
    """The values of all layers by precedence; mappings (`radios`, `ssh`, `extra_uci`) merge key by key.

    Paths become relative to `base`, the inventory's directory."""
    values: dict[str, Any] = {}
    for layer in reversed(layers):
        document = layer.document
        for name in document.model_fields_set:
            value = getattr(document, name)
            match value:
                case SshLayer():
                    values[name] = {**values.get(name, {}), **ssh_values(value, child(layer.tree, name), base)}
                case dict() if name == "radios":
                    radios = dict(values.get(name, {}))
                    for radio, settings in value.items():
                        radios[radio] = {**radios.get(radio, {}), **_written(settings)}
                    values[name] = radios
                case dict():
                    values[name] = {**values.get(name, {}), **value}
                case _:
                    values[name] = value
    return values


def ssh_values(document: SshLayer, tree: Tree | None, base: str) -> dict[str, Any]:
    """The values of an `ssh` mapping, `tree`, with paths relative to `base`, the inventory's directory."""
    values = _written(document)
    if tree is not None and "key_files" in values:
        folder = str(Path(tree.file).parent)
        values["key_files"] = tuple(from_inventory(file, folder, base) for file in values["key_files"])
    return values


def _written(document: SshLayer | RadioLayer) -> dict[str, Any]:
    return {name: getattr(document, name) for name in document.model_fields_set}


@dataclass(slots=True)
class _Building:
    hardware: Mapping[str, HardwareProfile]
    meshes: Mapping[str, Mesh]
    only_mesh: Mapping[Band, str]
    base: str
    names: tuple[str, ...] = ()
    diagnostics: list[Diagnostic] = field(default_factory=list)
    _templates: dict[tuple[Layer, ...], _Template | None] = field(default_factory=dict)
    _counts: Counter[Layer] = field(default_factory=Counter)
    _failed: set[Layer] = field(default_factory=set)
    # rules of addresses, with what is wrong with them: at the first of their nodes
    _wrong_rules: set[tuple[Layer, str]] = field(default_factory=set)

    def node(self, spec: NodeSpec, robot: str) -> Node | None:
        index_of = self._count(spec)
        if spec.layers not in self._templates:
            self._templates[spec.layers] = self._template(spec)
        template = self._templates[spec.layers]
        if template is None:
            return None
        address = self._address(spec, template, index_of)
        if address is None:
            return None
        return replace(
            template.node,
            name=spec.name,
            hostname=template.hostname or spec.name,
            address=address,
            robot=template.node.robot or robot,
        )

    def _count(self, spec: NodeSpec) -> dict[Layer, int]:
        """The node's index under each of its rules, including overridden ones, so that a node with its own address does
        not shift the others."""
        index_of = {}
        for layer in spec.layers:
            if isinstance(layer.document.address, AddressRule):
                self._counts[layer] += 1
                in_range = layer.title.startswith("range ")
                index_of[layer] = spec.range_index if in_range else self._counts[layer]
        return index_of

    def _template(self, spec: NodeSpec) -> _Template | None:
        values = merge_layers(spec.layers, self.base)
        address_layer = next((layer for layer in spec.layers if "address" in layer.document.model_fields_set), None)
        if address_layer is None:
            hint = "write `address: 10.42.0.11`, or a rule in its group or range: `address: {from: 10.42.0.101}`"
            # the entry of a node of a range, with another name
            near = "" if spec.entry.title.startswith("range ") else did_you_mean(spec.name, self.names)
            hint = f"{near} Or {hint}" if near else hint
            self._report(codes.BAD_ADDRESS, spec.entry, "the node has no address", hint=hint)
            if near and "hardware" not in values:
                return None
        profile = self._profile(spec, values)
        if profile is None or address_layer is None:
            return None
        radios = self._radios(spec, values, profile)
        first_mesh = next((radio.mesh for radio in radios if radio.mesh in self.meshes), None)
        node = Node(
            name=spec.name,
            hostname="",
            role=values.get("role", Role.BEACON),
            state=values.get("state", NodeState.DEPLOYED),
            hardware=profile,
            release=values.get("release", profile.release),
            address=_NO_ADDRESS,
            radios=radios,
            lan_ports=tuple(values.get("lan_ports", profile.lan_ports)),
            ssh=ssh_settings(values.get("ssh", {}), user="root"),
            robot=values.get("robot", ""),
            label=values.get("label", ""),
            serial=values.get("serial", ""),
            mac=values.get("mac", ""),
            host_keys=tuple(values.get("host_keys", ())),
            groups=spec.groups,
            confirm_window_s=values.get("confirm_window_s", profile.confirm_window_s),
            packages=tuple(values.get("packages", ())),
            extra_uci=MappingProxyType(values.get("extra_uci", {})),
            gateway=values.get("gateway"),
            position=fixed_position(values.get("position")),
            lan_filter=_lan_filter(values.get("lan_filter")),
            site=values.get("site", ""),
        )
        network = self.meshes[first_mesh].network if first_mesh is not None else None
        return _Template(node, values["address"], address_layer, values.get("hostname", ""), network)

    def _profile(self, spec: NodeSpec, values: Mapping[str, Any]) -> HardwareProfile | None:
        name = values.get("hardware")
        if name is None:
            hint = "write `hardware: NAME` at the node, in its group or in `defaults`"
            self._report(codes.UNKNOWN_HARDWARE, spec.entry, "the node has no hardware", hint=hint)
            return None
        profile = self.hardware.get(name)
        if profile is None:
            layer = next(layer for layer in spec.layers if "hardware" in layer.document.model_fields_set)
            self._report(
                codes.UNKNOWN_HARDWARE,
                layer,
                f"unknown hardware '{name}'",
                below=("hardware",),
                hint=did_you_mean(name, self.hardware),
            )
        return profile

    def _radios(self, spec: NodeSpec, values: Mapping[str, Any], profile: HardwareProfile) -> tuple[Radio, ...]:
        written: dict[str, dict[str, Any]] = values.get("radios", {})
        known = [radio.name for radio in profile.radios]
        for name in written:
            if name not in known:
                layer = next(layer for layer in spec.layers if name in layer.document.radios)
                self._report(
                    codes.UNKNOWN_RADIO,
                    layer,
                    f"the hardware '{profile.name}' has no radio '{name}'",
                    below=("radios", name),
                    expected=f"one of {', '.join(known)}" if known else "no radios",
                )
        return tuple(
            Radio(
                hardware=radio,
                mesh=settings["mesh"] if "mesh" in settings else self.only_mesh.get(radio.band),
                tx_power_dbm=settings.get("tx_power_dbm", radio.max_drive_dbm),
                mac=settings.get("mac", ""),
            )
            for radio in profile.radios
            for settings in (written.get(radio.name, {}),)
        )

    def _address(self, spec: NodeSpec, template: _Template, index_of: Mapping[Layer, int]) -> IpInterface | None:
        value, layer = template.address, template.address_layer
        if isinstance(value, IpInterface):
            return value
        if isinstance(value, AddressRule):
            try:
                value = value.address(template.network, index_of[layer])
            except BadAddress as reason:
                if (layer, str(reason)) in self._wrong_rules:
                    return None
                self._wrong_rules.add((layer, str(reason)))
                hint = self._bands(template.node) if template.network is None else ""
                self._report(codes.BAD_ADDRESS, layer, f"{reason} (node '{spec.name}')", below=("address",), hint=hint)
                return None
        return ip_interface((value, self._prefix_length(value, template.network)))

    def _bands(self, node: Node) -> str:
        """A hint for a node that is in no mesh."""
        return node.bands_beside(self.meshes.values()) if node.radios and self.meshes else ""

    def _prefix_length(self, address: IpAddress, network: IpNetwork | None) -> int:
        """The prefix length of the node's mesh, or that of a mesh with the address; else all bits."""
        if network is None or network.version != address.version:
            network = next((mesh.network for mesh in self.meshes.values() if address in mesh.network), None)
        return address.max_prefixlen if network is None else network.prefixlen

    def _report(
        self,
        code: str,
        layer: Layer,
        message: str,
        *,
        below: tuple[str, ...] = (),
        expected: str = "",
        hint: str = "",
    ) -> None:
        place = layer.position_of(below)
        diagnostic = codes.error(
            code, place, message, path=".".join((*layer.path, *below)), expected=expected, hint=hint
        )
        if diagnostic not in self.diagnostics[-8:]:
            self.diagnostics.append(diagnostic)


def without_entries_of(refused: Iterable[Diagnostic], found: Iterable[Diagnostic]) -> Iterator[Diagnostic]:
    """Without what the entries of nodes lack whose range was refused: the range would give it to them."""
    starts = tuple(
        re.split(r"[^A-Za-z0-9._-]", one.path.removeprefix("nodes."))[0]
        for one in refused
        if one.code == codes.BAD_RANGE and one.path.startswith("nodes.")
    )
    for one in found:
        is_entry = one.path.startswith("nodes.") and one.path.count(".") == 1
        if not (is_entry and starts and one.path.removeprefix("nodes.").startswith(tuple(filter(None, starts)))):
            yield one


def _complete(specs: Mapping[str, NodeSpec]) -> tuple[str, ...]:
    """The nodes with an address, whose names others may have misspelled; none if they are too many to compare."""
    names = tuple(
        spec.name
        for spec in specs.values()
        if any("address" in layer.document.model_fields_set for layer in spec.layers)
    )
    return names if len(names) <= _MAX_COMPARED else ()


def _only_meshes(meshes: Mapping[str, Mesh]) -> dict[Band, str]:
    """The mesh of each band with exactly one, the default for its radios."""
    counts = Counter(mesh.band for mesh in meshes.values())
    return {mesh.band: mesh.name for mesh in meshes.values() if counts[mesh.band] == 1}


def _lan_filter(document: LanFilterLayer | None) -> LanFilter | None:
    return None if document is None else LanFilter(document.udp_ports)


def fixed_position(document: PositionDocument | None) -> FixedPosition | None:
    return None if document is None else FixedPosition(document.x_m, document.y_m, document.z_m)


def ssh_settings(values: Mapping[str, Any], *, user: str) -> SshSettings:
    """`user` is the default."""
    return SshSettings(
        host=values.get("host", ""),
        port=values.get("port", 22),
        user=values.get("user", user),
        key_files=tuple(values.get("key_files", ())),
        jump=values.get("jump", ""),
    )
