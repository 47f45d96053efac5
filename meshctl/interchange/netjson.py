"""The planned fleet as NetJSON (draft-capoano-kaplan-netjson-00): NetworkGraph and DeviceConfiguration. Pure.

The graph has every link that the inventory allows: radios of one cell, by distance where both positions are known, and
the switch that a robot's radios share. `meshctl topology --format netjson` has the links that are up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import combinations
from typing import Any

from meshctl.model import Encryption, Fleet, MeshMode, Node, Secret, SecretRef
from meshctl.model.ip import IpInterface
from meshctl.resolve import Intent, resolve
from meshctl.resolve.intent import MeshInterface, RadioIntent

# The least cost: nothing is measured yet.
PLANNED_COST = 1.0
_ENCRYPTIONS: Mapping[Encryption, str] = {Encryption.PSK2: "wpa2_personal", Encryption.SAE: "wpa3_personal"}
_PROTOCOLS = {"VHT": "802.11ac", "HE": "802.11ax", "EHT": "802.11be"}
_MODES: Mapping[MeshMode, str] = {MeshMode.ADHOC: "adhoc", MeshMode.MESH: "802.11s"}


def network_graph(fleet: Fleet) -> dict[str, Any]:
    """The NetworkGraph of all managed nodes; ids are management addresses, as in `meshctl topology`."""
    return {
        "type": "NetworkGraph",
        "protocol": "static",
        # the text of the draft allows null, its schema does not
        "version": "",
        "metric": "",
        "label": fleet.name,
        "nodes": [
            {
                "id": str(node.address.ip),
                "label": node.name,
                "properties": {"role": node.role.value, "state": node.state.value, **_place(node)},
            }
            for node in fleet.managed()
        ],
        "links": [
            {"source": str(a.address.ip), "target": str(b.address.ip), "cost": PLANNED_COST, "properties": properties}
            for a, b, properties in _links(fleet)
        ],
    }


def _place(node: Node) -> dict[str, float]:
    place = node.position
    return {} if place is None else {"x_m": place.x_m, "y_m": place.y_m}


def _links(fleet: Fleet) -> Iterator[tuple[Node, Node, dict[str, Any]]]:
    """The pairs of nodes that may have a link, each once, wired ones first."""
    wired: set[frozenset[str]] = set()
    for robot in fleet.robots.values():
        mounted = (fleet.nodes.get(name) for name in robot.nodes)
        radios = [node for node in mounted if node is not None and node.state.is_managed]
        for a, b in combinations(radios, 2):
            wired.add(frozenset((a.name, b.name)))
            yield a, b, {"wired": True}
    for a, b in combinations(tuple(fleet.managed()), 2):
        shared = [name for name in a.meshes if name in b.meshes and _may_hear(fleet, name, a, b)]
        if shared and frozenset((a.name, b.name)) not in wired:
            yield a, b, {"wired": False, "meshes": shared}


def _may_hear(fleet: Fleet, mesh: str, a: Node, b: Node) -> bool:
    """Whether two nodes are within the longest link of the mesh, as far as their positions are known."""
    if a.position is None or b.position is None:
        return True
    heights = (a.position.z_m or 0.0, b.position.z_m or 0.0)
    apart = math.dist((a.position.x_m, a.position.y_m, heights[0]), (b.position.x_m, b.position.y_m, heights[1]))
    return apart <= fleet.meshes[mesh].distance_m


def configurations(fleet: Fleet, nodes: Iterable[Node], secrets: Callable[[SecretRef], Secret]) -> dict[str, Any]:
    """One node's DeviceConfiguration, or a NetworkCollection of several. Mesh keys are never in it: they
    are empty.

    NetJSON has no keys for batman-adv, firewall and SSH, which are left out. Raises InvalidInput for nodes that cannot
    be rendered.
    """
    found = [_configuration(resolve(fleet, node, secrets), fleet) for node in nodes]
    return found[0] if len(found) == 1 else {"type": "NetworkCollection", "collection": found}


def _configuration(intent: Intent, fleet: Fleet) -> dict[str, Any]:
    node = fleet.nodes[intent.node]
    lan = intent.lan
    interfaces: list[dict[str, Any]] = [_ethernet(port) for port in node.lan_ports]
    interfaces += [_wireless(radio, radio.interface) for radio in intent.radios if radio.interface is not None]
    interfaces.append(
        {
            "name": lan.bridge,
            "type": "bridge",
            "bridge_members": list(lan.ports),
            "mtu": lan.mtu,
            "addresses": [_address(lan.address, lan.gateway)],
        }
    )
    if intent.backbone is not None:
        backbone = intent.backbone
        interfaces.append(
            {
                "name": backbone.device,
                "type": "virtual",
                "mac": backbone.mac,
                "mtu": backbone.mtu,
                "addresses": [_address(backbone.address, backbone.gateway)],
            }
        )
    return {
        "type": "DeviceConfiguration",
        "general": {"hostname": intent.hostname, "timezone": intent.system.zonename or "UTC"},
        "hardware": {"manufacturer": intent.board.partition(",")[0], "model": intent.board.partition(",")[2]},
        "operating_system": {"name": "OpenWrt", "version": str(intent.release)},
        "radios": [_radio(radio) for radio in intent.radios],
        "interfaces": interfaces,
        "routes": [
            {
                "device": lan.bridge if intent.backbone is None else intent.backbone.device,
                "destination": str(route.target),
                "next": str(route.gateway),
                "cost": 0,
            }
            for route in intent.routes
        ],
    }


def _ethernet(port: str) -> dict[str, Any]:
    return {"name": port, "type": "ethernet"}


def _radio(radio: RadioIntent) -> dict[str, Any]:
    """`channel` is 0, which NetJSON reads as automatic, for a radio that is off."""
    return {
        "name": radio.name,
        "protocol": _PROTOCOLS.get(radio.htmode.rstrip("0123456789+-"), "802.11n"),
        "channel": radio.channel or 0,
        "channel_width": _width_mhz(radio.htmode),
        "tx_power": radio.tx_power_dbm,
        "country": radio.country,
        "disabled": radio.interface is None,
    }


def _width_mhz(htmode: str) -> int:
    """HT20, HT40+, VHT80, ... -> MHz."""
    digits = "".join(letter for letter in htmode if letter.isdigit())
    return int(digits) if digits else 20


def _wireless(radio: RadioIntent, interface: MeshInterface) -> dict[str, Any]:
    # the draft requires an SSID of every mode
    wireless: dict[str, Any] = {"radio": radio.name, "mode": _MODES[interface.mode], "ssid": interface.ssid}
    if interface.mode is MeshMode.ADHOC:
        wireless["bssid"] = interface.bssid
    else:
        wireless["mesh_id"] = interface.ssid
    if interface.encryption in _ENCRYPTIONS:
        # the draft requires a key
        wireless["encryption"] = {"protocol": _ENCRYPTIONS[interface.encryption], "key": ""}
    return {"name": interface.name, "type": "wireless", "mtu": interface.mtu, "wireless": wireless}


def _address(address: IpInterface, gateway: object) -> dict[str, Any]:
    found = {
        "address": str(address.ip),
        "mask": address.network.prefixlen,
        "proto": "static",
        "family": f"ipv{address.version}",
    }
    return found if gateway is None else {**found, "gateway": str(gateway)}
