"""Static routes to the robots' own LANs, and the gateways of their computers. Pure.

Every node of a mesh gets a route to each LAN, also a node that only relays: its replies to the operator's machine leave
through the base, if that is a router too. The next hop is the mesh address of the LAN's router, so the routes depend on
the inventory only; batman-adv finds the path to the router.
"""

from __future__ import annotations

from dataclasses import dataclass

from meshctl.model import Fleet, Node, Robot
from meshctl.model.ip import IpAddress, IpNetwork


@dataclass(frozen=True, slots=True)
class StaticRoute:
    """`target` is the LAN of `robot`, `gateway` its router's address in the mesh."""

    robot: str
    target: IpNetwork
    gateway: IpAddress


def routes(fleet: Fleet, node: Node) -> tuple[StaticRoute, ...]:
    """The node's routes to the LANs of all other robots whose router is in the node's mesh network."""
    found = []
    for robot in fleet.robots.values():
        if robot.lan is None or node.name in robot.nodes:
            continue
        router = fleet.router(robot)
        if router is not None and router.address.ip in node.address.network:
            found.append(StaticRoute(robot.name, robot.lan, router.address.ip))
    return tuple(found)


def has_routed_lans(fleet: Fleet) -> bool:
    """Whether a robot has a LAN of its own: broadcasts then do not reach all robots."""
    return any(robot.lan is not None for robot in fleet.robots.values())


def computer_gateway(fleet: Fleet, robot: Robot) -> IpAddress | None:
    """The next hop of the robot's computer to other networks: as set, else the robot's router or first managed radio.

    None without a radio, and in a fleet without routed LANs.
    """
    if robot.computer is not None and robot.computer.gateway is not None:
        return robot.computer.gateway
    router = fleet.router(robot)
    if router is not None and router.lan_address is not None:
        return router.lan_address.ip
    if robot.lan is not None or not has_routed_lans(fleet):
        return None
    nodes = (fleet.nodes.get(name) for name in robot.nodes)
    return next((node.address.ip for node in nodes if node and node.state.is_managed), None)
