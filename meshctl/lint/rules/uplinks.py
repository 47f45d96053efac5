"""Where the nodes' default routes lead (MC223)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.trial_rendering import has_own_templates
from meshctl.model import Fleet, Node
from meshctl.model.ip import IpAddress


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
    if has_own_templates(fleet):
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


def _has_uplink(fleet: Fleet, node: Node) -> bool:
    has_interface = any(key.startswith("network.") and value == "interface" for key, value in node.extra_uci.items())
    is_router = node.gateway is not None or node.lan_address is not None
    own_parts = any(fleet.meshes[name].operator_parts.templates for name in node.meshes if name in fleet.meshes)
    return has_interface or is_router or own_parts
