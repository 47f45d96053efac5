"""Where the nodes' default routes and batman-adv's clients lead (MC223 to MC225)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.addresses import as_address, stations
from meshctl.model import Fleet, Node
from meshctl.model.ip import IpAddress
from meshctl.wording import join_limited


@fleet_rule(
    "MC223",
    Severity.WARNING,
    "A node's gateway is a radio without an uplink",
    why="""The radio has no interface outside the mesh and no gateway of its own: packets to the internet, such as those
    to a time server, end there.""",
    fix="""Use the address of the router or of the radio with the uplink, whose interface is in its `extra_uci`
    (`network.wan: interface`).""",
    failing="nodes: {b01: {gateway: 10.42.0.1}}",
    passing="""
    nodes: {b01: {gateway: 10.42.0.1}, base: {extra_uci: {network.wan: interface, network.wan.device: eth1,
      network.wan.proto: dhcp}}}
    """,
)
def gateway_without_uplink(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if _has_own_network(fleet):
        return
    radios: dict[IpAddress, Node] = {node.address.ip: node for node in fleet.nodes.values()}
    for node in fleet.managed():
        router = radios.get(node.gateway) if node.gateway is not None else None
        if router is None or router is node:
            continue
        path = ("nodes", node.name, "gateway")
        if not router.state.is_managed:
            message, expected = f"{router.name} is {router.state.value}", "a router, or a radio in use with an uplink"
            yield Finding(path, message, expected, str(node.gateway))
            continue
        if _has_uplink(fleet, router):
            continue
        yield Finding(path, f"{router.name} has no uplink", "a router, or a radio with an uplink", str(node.gateway))


def _has_own_network(fleet: Fleet) -> bool:
    """Whether a template of the inventory writes /etc/config/network, with whatever interfaces."""
    return any((Path(fleet.base) / "templates").glob("*/etc/config/*network*.j2"))


def _has_uplink(fleet: Fleet, node: Node) -> bool:
    has_interface = any(key.startswith("network.") and value == "interface" for key, value in node.extra_uci.items())
    is_router = node.gateway is not None or node.lan_address is not None
    own_parts = any(fleet.meshes[name].operator_parts.templates for name in node.meshes if name in fleet.meshes)
    return has_interface or is_router or own_parts


@fleet_rule(
    "MC224",
    Severity.WARNING,
    "No node is a gateway for batman-adv's clients",
    why="""With `gw_mode: client`, batman-adv sends DHCP requests to the best gateway that announces itself. Without one
    they are flooded as before, and devices that expect an address from the internet gateway get none.""",
    fix="Set `extra_uci: {network.bat0.gw_mode: server}` on the nodes with an uplink, or remove `gw_mode`.",
    failing="meshes: {main: {batman: {gw_mode: client}}}",
    passing="""
    meshes: {main: {batman: {gw_mode: client}}}
    nodes: {base: {extra_uci: {network.bat0.gw_mode: server}}}
    """,
)
def clients_without_gateway(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if _has_own_network(fleet):
        return
    serving = {
        fleet.meshes[name].network
        for node in fleet.managed()
        if any(key.endswith(".gw_mode") and value == "server" for key, value in node.extra_uci.items())
        for name in node.meshes
        if name in fleet.meshes
    }
    for mesh in fleet.meshes.values():
        if mesh.batman.gw_mode == "client" and mesh.network not in serving:
            path = ("meshes", mesh.name, "batman", "gw_mode")
            yield Finding(path, "no node of the mesh is a gateway", "a node with gw_mode server", "clients only")


@fleet_rule(
    "MC225",
    Severity.NOTE,
    "A gateway has the address of no station in the inventory",
    why="""Packets to other networks go to this address. If no router there has it, and it was mistyped, the nodes
    reach no time server and no server beyond the mesh, and no command says so.""",
    fix="""Use the address of the node with the uplink. For a router that is not in the inventory, suppress this finding
    with its name.""",
    failing="nodes: {b01: {gateway: 10.42.0.254}}",
    passing="nodes: {b01: {gateway: 10.42.0.100}}",
)
def gateway_not_a_station(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # MC223 reports a gateway that is not in use; a site's gateway may be the router
    known = {address for address, _ in stations(fleet)} | {node.address.ip for node in fleet.nodes.values()}
    known |= {address for site in fleet.sites.values() if (address := as_address(site.ssh.host)) is not None}
    using = group_by_key((node.gateway, node) for node in fleet.managed() if node.gateway is not None)
    for gateway, nodes in using.items():
        # MC204 reports one that is not in the node's network
        own = [address for node in nodes for address in node.addresses]
        if gateway in known or not any(gateway in address.network for address in own):
            continue
        path = ("nodes", nodes[0].name, "gateway")
        message = f"{join_limited([node.name for node in nodes])}: no station in the inventory has this address"
        yield Finding(path, message, "the address of a node with an uplink", str(gateway))
