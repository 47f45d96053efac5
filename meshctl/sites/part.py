"""A site's part of the inventory: the nodes, meshes and secrets of the site, and no others'. Pure.

`site_part` takes the inventory's tree as it was read, removes what the site does not need, and names each file that
the rest needs by its path in the part. Addresses are written at every node, since a rule (`{from: 10.42.0.101}`) would
count fewer nodes there. `differences` compares what the worker will read with what the operator sees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath
from typing import Any

import yaml

from meshctl.inventory.ranges import expand
from meshctl.inventory.tree import MappingNode, Plain, plain_data
from meshctl.model import Firmware, Fleet, HardwareProfile, Node, OperatorParts, Secret, SecretRef, SshSettings

INVENTORY_FILE = "fleet.yaml"
SECRETS_FILE = "secrets.yaml"
KNOWN_HOSTS_FILE = "known_hosts"
# Beside the inventory: what a rollback returns nodes to, and what a plan would replace on them (cli/site_files).
EARLIER_FILE = "earlier.json"
REPLACED_FILE = "replaced.json"
# Names the folder of both to a command that a worker starts.
FILES_VARIABLE = "MESHCTL_SITE_FILES"
# Sections that concern robots' computers and the operator's other sites.
_REMOVED_SECTIONS = ("include", "topics", "sites", "nats")
# The entry of a secret that the site does not get. Nothing there asks for it.
_WITHHELD = "withheld"


@dataclass(frozen=True, slots=True)
class PartFile:
    """A file or folder of the operator's that the part contains as `path`: `written` relative to `base`."""

    path: str
    written: str
    base: str
    is_image: bool = False
    is_folder: bool = False


@dataclass(frozen=True, slots=True)
class SitePart:
    """`inventory` is the text of its inventory file, `secrets` that of its file of secrets."""

    inventory: str
    secrets: str = field(repr=False)
    files: tuple[PartFile, ...]


def site_part(
    root: MappingNode,
    fleet: Fleet,
    site: str,
    secrets: Callable[[SecretRef], Secret],
    *,
    with_firmware: bool,
) -> SitePart:
    """The part of `site`. `root` is the tree of the inventory that `fleet` was built from.

    Raises InputError for a secret that the site needs and the operator does not have.
    """
    data: dict[str, Any] = dict(_mapping(plain_data(root)))
    for section in _REMOVED_SECTIONS:
        data.pop(section, None)
    members = {name: node for name, node in fleet.nodes.items() if node.site == site}
    known = _keep_nodes(data, fleet, frozenset(members))
    _keep_robots(data, fleet, known)
    _only_operators(data, fleet, site)
    meshes = dict.fromkeys(mesh for node in members.values() for mesh in node.meshes)
    revealed = _secrets(data, fleet, meshes, secrets)
    profiles = {node.hardware.name: node.hardware for node in members.values()}
    files = (
        *_hardware_files(data, profiles, fleet.base, with_firmware=with_firmware),
        *_mesh_files(data, fleet, meshes),
    )
    return SitePart(_yaml(data), _yaml(revealed), files)


def _mapping(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _keep_nodes(data: dict[str, Any], fleet: Fleet, members: frozenset[str]) -> tuple[str, ...]:
    """Keep the entries with members. A range may contain other nodes, too; all nodes of the part are returned."""
    entries = _mapping(data.get("nodes"))
    kept = {pattern: entry for pattern, entry in entries.items() if not members.isdisjoint(expand(pattern))}
    names = tuple(dict.fromkeys(name for pattern in kept for name in expand(pattern)))
    for name in names:
        kept[name] = {**_mapping(kept.get(name)), "address": Plain(str(fleet.nodes[name].address))}
    data["nodes"] = kept
    layers = [data.get("defaults"), *_mapping(data.get("groups")).values(), *kept.values()]
    for layer in map(_mapping, layers):
        # paths on the operator's computer
        _mapping(layer.get("ssh")).pop("key_files", None)
    return names


def _keep_robots(data: dict[str, Any], fleet: Fleet, names: tuple[str, ...]) -> None:
    """Keep the robots of these nodes, since routes and filters depend on them, and nothing of their daemons."""
    robots = _mapping(data.get("robots"))
    kept: dict[str, Any] = {}
    for name, entry in robots.items():
        listed = {
            key: [node for node in getattr(fleet.robots[name], key) if node in names] for key in ("nodes", "carries")
        }
        if any(listed.values()) or any(fleet.nodes[node].robot == name for node in names):
            kept[name] = {key: value for key, value in _mapping(entry).items() if key not in ("relay", "thin", *listed)}
            kept[name].update({key: nodes for key, nodes in listed.items() if nodes})
            _mapping(kept[name].get("computer")).pop("links", None)
    data["robots"] = kept
    for key in ("keys", "relay_keys", "thin_links"):
        _mapping(data.get("udp_mesh")).pop(key, None)


def _only_operators(data: dict[str, Any], fleet: Fleet, site: str) -> None:
    """Make the worker's key one of the operators': the part itself has no sites."""
    operators = data["operators"] = dict(_mapping(data.get("operators")))
    operators["known_hosts"] = KNOWN_HOSTS_FILE
    worker_key = fleet.sites[site].worker_key
    if worker_key:
        operators["ssh_keys"] = [*fleet.operators.ssh_keys, worker_key]


def _secrets(
    data: dict[str, Any], fleet: Fleet, meshes: Mapping[str, None], secrets: Callable[[SecretRef], Secret]
) -> dict[str, str]:
    """Refer each mesh's key to the part's own file; returns the content of that file."""
    revealed: dict[str, str] = {}
    for name, entry in _mapping(data.get("meshes")).items():
        key = fleet.meshes[name].key
        if key is None:
            continue
        is_needed = name in meshes
        entry["key"] = {"file": SECRETS_FILE, "key": name if is_needed else f"{_WITHHELD} {name}"}
        if is_needed:
            revealed[name] = secrets(key).reveal()
    return revealed


def _hardware_files(
    data: dict[str, Any], profiles: Mapping[str, HardwareProfile], base: str, *, with_firmware: bool
) -> Iterator[PartFile]:
    for name, entry in _mapping(data.get("hardware")).items():
        profile = profiles.get(name)
        if profile is None or not with_firmware:
            entry.pop("firmware", None)
        if profile is None:
            entry.pop("package_files", None)
            continue
        firmware = _mapping(entry.get("firmware"))
        for key in ("image", "usign_key"):
            written = getattr(profile.firmware, key)
            if firmware and written:
                path = firmware[key] = f"firmware/{name}/{PurePosixPath(written).name}"
                yield PartFile(path, written, profile.firmware.base, is_image=key == "image")
        yield from _package_files(entry, f"packages/{name}", profile.package_files, base)


def _mesh_files(data: dict[str, Any], fleet: Fleet, meshes: Mapping[str, None]) -> Iterator[PartFile]:
    for name, entry in _mapping(data.get("meshes")).items():
        parts, written = fleet.meshes[name].operator_parts, _mapping(entry.get("operator_parts"))
        if name not in meshes:
            written.pop("templates", None)
            written.pop("package_files", None)
            continue
        if parts.templates:
            path = written["templates"] = f"operator-parts/{name}"
            yield PartFile(path, parts.templates, parts.base, is_folder=True)
        yield from _package_files(written, f"packages/mesh-{name}", parts.package_files, fleet.base)


def _package_files(entry: dict[str, Any], folder: str, files: tuple[str, ...], base: str) -> Iterator[PartFile]:
    if files:
        entry["package_files"] = [f"{folder}/{PurePosixPath(file).name}" for file in files]
        for path, file in zip(entry["package_files"], files, strict=True):
            yield PartFile(path, file, base)


def _yaml(data: object) -> str:
    """YAML in which a value is unquoted exactly if it was: then the field that reads it decides its type."""
    return yaml.serialize(_node(data), Dumper=yaml.SafeDumper, allow_unicode=True, width=2**31)


def _node(value: object) -> yaml.Node:
    match value:
        case dict():
            pairs = [(_text(str(key)), _node(item)) for key, item in value.items()]
            return yaml.MappingNode("tag:yaml.org,2002:map", pairs, flow_style=False)
        case list():
            return yaml.SequenceNode("tag:yaml.org,2002:seq", [_node(item) for item in value], flow_style=False)
        case None:
            return yaml.ScalarNode("tag:yaml.org,2002:null", "null")
        case Plain():
            return yaml.ScalarNode(_tag(str(value)), str(value))
        case _:
            return _text(str(value))


def _tag(text: str) -> str:
    """The tag that a reader gives to the unquoted text: with any other one it would be quoted."""
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    return "tag:yaml.org,2002:str" if node is None else str(node.tag)


def _text(text: str) -> yaml.Node:
    return yaml.ScalarNode("tag:yaml.org,2002:str", text, style='"')


def differences(fleet: Fleet, part: Fleet, site: str) -> Iterator[str]:
    """Values that the worker would read differently from the operator: `b03: address`. Any is a bug in meshctl."""
    for name, node in fleet.nodes.items():
        if node.site != site:
            continue
        there = part.nodes.get(name)
        if there is None:
            yield f"{name}: missing"
            continue
        for key in Node.__dataclass_fields__:
            if _comparable(getattr(node, key)) != _comparable(getattr(there, key)):
                yield f"{name}: {key}"
        for mesh in node.meshes:
            here = fleet.meshes[mesh]
            if replace(here, key=None, operator_parts=OperatorParts()) != replace(
                part.meshes[mesh], key=None, operator_parts=OperatorParts()
            ):
                yield f"mesh {mesh}"
    for key in ("name", "country", "system", "apply"):
        if getattr(fleet, key) != getattr(part, key):
            yield key


def _comparable(value: object) -> object:
    """The value without paths of the operator's computer."""
    match value:
        case HardwareProfile():
            return replace(value, firmware=Firmware(), package_files=())
        case SshSettings():
            return replace(value, key_files=())
        case _:
            return value
