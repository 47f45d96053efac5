"""The addresses of interfaces of extra_uci (MC931)."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import IPv4Interface, IPv4Network

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.rendering import created_sections, with_extra
from meshctl.model import Fleet

_CAMERA = """
    nodes: {b01: {extra_uci: {network.camera: interface, network.camera.device: eth1, network.camera.proto: static,
      network.camera.ipaddr: ADDRESS}}}
    """


@fleet_rule(
    "MC931",
    Severity.ERROR,
    "The address of an interface of extra_uci is its network's own",
    why="""The first address of an IPv4 network stands for the network, the last one for all its stations. No station
    answers at either: clients do not reach the node, and those that it gives addresses to have no gateway.""",
    fix="Use an address between them, such as the network's first address plus one.",
    failing=_CAMERA.replace("ADDRESS", "172.20.0.0/24"),
    passing=_CAMERA.replace("ADDRESS", "172.20.0.1/24"),
    is_per_kind=True,
)
def interface_address_of_network(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for name, interface in created_sections(node, packages, "network"):
            if interface.type != "interface" or interface.get("proto") != "static":
                continue
            for word in interface.get("ipaddr").split():
                network, kind = _reserved(word, interface.get("netmask"))
                if network is not None:
                    path = ("nodes", node.name, "extra_uci", f"network.{name}.ipaddr")
                    yield Finding(path, f"the {kind} address of {network}", f"{network[1]} to {network[-2]}", word)


def _reserved(address: str, netmask: str) -> tuple[IPv4Network | None, str]:
    """The network whose own or broadcast address this is, and which of the two; none if it is a station's."""
    try:
        # MC924 reports an address without a netmask
        found = IPv4Interface(address if "/" in address else f"{address}/{netmask or 32}")
    except ValueError:
        return None, ""
    network = found.network
    # RFC 3021: both addresses of a /31 are stations'
    if network.prefixlen >= 31 or found.ip not in (network.network_address, network.broadcast_address):
        return None, ""
    return network, "network" if found.ip == network.network_address else "broadcast"
