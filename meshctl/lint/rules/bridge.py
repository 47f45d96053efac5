"""Bridging into the robot's LAN: ports, loops, confirm windows, extra options, broadcasts (MC521 to MC534)."""

from __future__ import annotations

import re
from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates, group_by_key
from meshctl.lint.places import first_written
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.routing import MESHMERIZE, PARTS
from meshctl.model import Backend, Fleet, Mesh, Node
from meshctl.wording import join_limited

# resynchronization of loop avoidance blocks broadcasts for up to 30 s; the rest is for the health checks
_LOOP_AVOIDANCE_S = 60
# interfaces on the mesh side of the bridge
_NOT_PORTS = ("bat", "mesh", "wlan", "phy", "br-")
# UCI options set by inventory keys, by package: the key, or empty if meshctl decides
_CHECKED = {
    "wireless": {
        "channel": "meshes.NAME.channel",
        "htmode": "meshes.NAME.htmode",
        "band": "hardware.NAME.radios",
        "hwmode": "hardware.NAME.radios",
        "country": "country",
        "txpower": "radios.RADIO.tx_power_dbm",
        "distance": "meshes.NAME.distance_m",
        "disabled": "radios.RADIO.mesh",
        "path": "hardware.NAME.radios",
        "ssid": "meshes.NAME.ssid",
        "bssid": "meshes.NAME.bssid",
        "mode": "meshes.NAME.mode",
        "encryption": "meshes.NAME.encryption",
        "key": "meshes.NAME.key",
        "mcast_rate": "meshes.NAME.mcast_rate_kbps",
        "beacon_int": "meshes.NAME.beacon_interval_tu",
        "mesh_id": "meshes.NAME.ssid",
        "mesh_fwding": "",
        "network": "",
        "ifname": "",
    },
    "network": {
        "ipaddr": "address",
        "netmask": "meshes.NAME.network",
        "gateway": "gateway",
        "ports": "lan_ports",
        "ifname": "lan_ports",
        "device": "",
        "proto": "",
        "mtu": "meshes.NAME.mtu",
        "master": "",
        "routing_algo": "meshes.NAME.batman",
        "bridge_loop_avoidance": "meshes.NAME.batman",
        "orig_interval": "meshes.NAME.batman",
        "hop_penalty": "meshes.NAME.batman",
        "fragmentation": "meshes.NAME.batman",
    },
    "dropbear": {
        "Port": "ssh.port",
        "PasswordAuth": "operators.password_login",
        "RootPasswordAuth": "operators.password_login",
        "RootLogin": "",
        "Interface": "",
        "enable": "",
    },
    "system": {
        "hostname": "hostname",
        "log_ip": "system.log_host",
        "log_port": "system.log_port",
        "timezone": "system.timezone",
        "zonename": "system.zonename",
    },
}
# options that a radio without a mesh needs to serve an access point, because it has no mesh to take them from
_ACCESS_POINT_OPTIONS = ("channel", "htmode", "disabled")
# sections that meshctl renders, besides radios
_RENDERED = re.compile(r"mesh[0-9]+|bat[0-9]+|lan|backbone|loopback|br_lan|main|@[a-z-]+\[-?[0-9]+\]")
_TWO_RADIOS = """
nodes: {husky1-rear: {role: robot, address: 10.42.0.12, label: H1R}}
robots: {husky1: {nodes: [husky1-front, husky1-rear]}}
"""


def _bridged_pairs(fleet: Fleet) -> Iterator[tuple[str, Mesh, list[Node]]]:
    """Robots with several nodes of one mesh that are bridged onto the robot's switch."""
    for robot in fleet.robots.values():
        nodes = [fleet.nodes[name] for name in dict.fromkeys(robot.nodes) if name in fleet.nodes]
        # routers do not bridge
        bridged = [node for node in nodes if node.state.is_managed and node.lan_ports and node.lan_address is None]
        for mesh, members in group_by_key((mesh, node) for node in bridged for mesh in node.meshes).items():
            if len(members) > 1 and mesh in fleet.meshes:
                yield robot.name, fleet.meshes[mesh], members


@fleet_rule(
    "MC521",
    Severity.ERROR,
    "Two radios share a switch without loop avoidance",
    why="""Both radios bridge the mesh to the same switch: a broadcast enters through one, leaves through the other and
    circulates. Within seconds the broadcast storm fills every link of the fleet, not only this robot's.""",
    fix="Set `batman: {bridge_loop_avoidance: true}` on the mesh, or bridge only one of the radios (`lan_ports: []`).",
    failing="meshes: {main: {batman: {bridge_loop_avoidance: false}}}" + _TWO_RADIOS,
    passing="meshes: {main: {batman: {bridge_loop_avoidance: true}}}" + _TWO_RADIOS,
)
def loop_without_avoidance(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot, mesh, nodes in _bridged_pairs(fleet):
        if mesh.backend is Backend.BATMAN and not mesh.batman.bridge_loop_avoidance:
            names = join_limited([node.name for node in nodes])
            path = ("meshes", mesh.name, "batman", "bridge_loop_avoidance")
            yield Finding(path, f"{names} share the switch of {robot}", "true", "false")


@fleet_rule(
    "MC522",
    Severity.WARNING,
    "Two radios share a switch over a back end with unknown loop avoidance",
    why="""meshctl knows only batman-adv's loop avoidance. With another back end, two bridged radios form a loop unless
    the back end prevents it.""",
    fix="Make sure that the back end prevents the loop and suppress this finding, or bridge only one of the radios.",
    failing=Example(MESHMERIZE + _TWO_RADIOS, files=PARTS),
    passing=Example(MESHMERIZE, files=PARTS),
)
def loop_over_other_back_end(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot, mesh, nodes in _bridged_pairs(fleet):
        if mesh.backend is not Backend.BATMAN:
            names = join_limited([node.name for node in nodes])
            message = f"{names} share the switch of {robot}"
            yield Finding(
                ("meshes", mesh.name, "backend"), message, "batman-adv, or one bridged radio", mesh.backend.value
            )


@fleet_rule(
    "MC523",
    Severity.ERROR,
    "The confirm window is too short for loop avoidance",
    why="""After a change, loop avoidance can block broadcasts for 30 seconds while its nodes resynchronize. The
    operator cannot confirm during that time, and a good change is rolled back.""",
    fix="Set `confirm_window_s` to more than 60.",
    failing="hardware: {rocket: {confirm_window_s: 45}}",
    passing="hardware: {rocket: {confirm_window_s: 120}}",
)
def confirm_window_short(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        avoiding = any(_avoids_loops(fleet, mesh) for mesh in node.meshes)
        if avoiding and node.lan_ports and node.lan_address is None and node.confirm_window_s <= _LOOP_AVOIDANCE_S:
            path = ("nodes", node.name, "confirm_window_s")
            if node.confirm_window_s == node.hardware.confirm_window_s:
                path = ("hardware", node.hardware.name, "confirm_window_s")
            expected = f"more than {_LOOP_AVOIDANCE_S} s"
            yield Finding(path, "too short for loop avoidance", expected, f"{node.confirm_window_s} s")


def _avoids_loops(fleet: Fleet, name: str) -> bool:
    mesh = fleet.meshes.get(name)
    return mesh is not None and mesh.backend is Backend.BATMAN and mesh.batman.bridge_loop_avoidance


@fleet_rule(
    "MC524",
    Severity.WARNING,
    "The confirm window is very long",
    why="A node that a bad change cuts off stays cut off until the window ends.",
    fix="Use at most 600 s.",
    failing="hardware: {rocket: {confirm_window_s: 1800}}",
    passing="hardware: {rocket: {confirm_window_s: 300}}",
)
def confirm_window_long(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        if node.confirm_window_s > 600:
            path = ("nodes", node.name, "confirm_window_s")
            if node.confirm_window_s == node.hardware.confirm_window_s:
                path = ("hardware", node.hardware.name, "confirm_window_s")
            found = f"{node.confirm_window_s} s"
            yield Finding(path, "a bad change stays that long", "at most 600 s", found)


@fleet_rule(
    "MC525",
    Severity.ERROR,
    "A bridge port is listed twice",
    why="netifd adds the port once and fails the second time; on 19.07 the bridge may come up without it.",
    fix="List each port once.",
    failing="hardware: {rocket: {lan_ports: [eth0, eth0]}}",
    passing="hardware: {rocket: {lan_ports: [eth0, eth1]}}",
)
def port_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for place, ports in port_lists(fleet):
        for port, indexes in duplicates((port, index) for index, port in enumerate(ports)):
            yield Finding((*place, str(indexes[1])), "listed twice", "each port once", port)


def port_lists(fleet: Fleet) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Each list of LAN ports, with the path of its key."""
    for profile in fleet.hardware.values():
        yield ("hardware", profile.name, "lan_ports"), profile.lan_ports
    for node in fleet.nodes.values():
        if node.lan_ports != node.hardware.lan_ports:
            yield ("nodes", node.name, "lan_ports"), node.lan_ports


@fleet_rule(
    "MC526",
    Severity.ERROR,
    "A bridge port belongs to the mesh",
    why="""meshctl bridges the routing interface itself. An additional radio interface in the bridge carries every frame
    twice, bypassing the routing: a loop that loop avoidance cannot detect.""",
    fix="List wired ports only, as in /etc/board.json on the device.",
    failing="hardware: {rocket: {lan_ports: [eth0, bat0]}}",
    passing="hardware: {rocket: {lan_ports: [eth0]}}",
)
def port_of_mesh(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for place, ports in port_lists(fleet):
        for index, port in enumerate(ports):
            if port.startswith(_NOT_PORTS) or port == "lo":
                yield Finding((*place, str(index)), "not a wired port", "a port such as eth0 or lan1", port)


@fleet_rule(
    "MC527",
    Severity.ERROR,
    "A port and one of its VLANs are both bridged",
    why="eth0 carries eth0.1: with both in the bridge, frames of the VLAN enter twice and loop.",
    fix="List either the VLANs or the port.",
    failing="hardware: {rocket: {lan_ports: [eth0, eth0.1], switch_vlans: {1: 3 0t}}}",
    passing="hardware: {rocket: {lan_ports: [eth0.1, eth0.2], switch_vlans: {1: 3 0t, 2: 2 0t}}}",
)
def port_and_vlan(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for place, ports in port_lists(fleet):
        for index, port in enumerate(ports):
            parent, dot, _ = port.partition(".")
            if dot and parent in ports:
                yield Finding((*place, str(index)), f"{parent} is bridged as well", "one of the two", port)


@fleet_rule(
    "MC528",
    Severity.ERROR,
    "A robot's radio has no wired port",
    why="Nothing connects the mesh to the robot's switch: the radio is on the air, but the computer receives nothing.",
    fix="List the ports from /etc/board.json in `lan_ports`.",
    failing="nodes: {husky1-front: {lan_ports: []}}",
    passing="nodes: {husky1-front: {lan_ports: [eth0]}}",
)
def robot_without_port(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    cut_off: list[tuple[tuple[str, ...], str]] = []
    for robot in fleet.robots.values():
        nodes = [fleet.nodes[name] for name in robot.nodes if name in fleet.nodes]
        if robot.computer is not None and nodes and not any(node.lan_ports for node in nodes):
            profile = ("hardware", nodes[0].hardware.name, "lan_ports")
            cut_off.append((first_written(fleet, ("nodes", nodes[0].name, "lan_ports"), profile), robot.name))
    # report a profile without ports once, however many robots use it
    for path, robots in group_by_key(cut_off).items():
        yield Finding(path, f"the computer of {join_limited(robots)} is cut off", "at least one port", "none")


@fleet_rule(
    "MC529",
    Severity.WARNING,
    "An extra UCI option overrides a checked setting",
    why="""`extra_uci` is applied after the templates and can change channel, power, addresses and bridges after every
    check has passed: the cell may split, a limit may be exceeded, or a node lost, unnoticed. Sections that `extra_uci`
    itself creates, such as an access point, are not checked.""",
    fix="Use the inventory's own key, which is checked; without one, remove the option.",
    failing="nodes: {b01: {extra_uci: {wireless.radio0.channel: '11'}}}",
    passing="""
    nodes:
      b01:
        extra_uci: {wireless.radio0.rts: '500', wireless.guest: wifi-iface, wireless.guest.device: radio0,
          wireless.guest.mode: ap, wireless.guest.ssid: guests, wireless.guest.network: visitors,
          network.visitors: interface, network.visitors.proto: none, network.bat0.gw_mode: server}
    """,
)
def extra_checked(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        for key in node.extra_uci:
            package, _, rest = key.partition(".")
            section, _, option = rest.rpartition(".")
            own = _CHECKED.get(package, {}).get(option)
            if section and own is not None and not _is_unchecked(node, package, section, option):
                path = ("nodes", node.name, "extra_uci", key)
                yield Finding(path, "overrides a checked setting", own or "no such option in extra_uci", key)


def _is_unchecked(node: Node, package: str, section: str, option: str) -> bool:
    """Whether the option is one of a section that meshctl does not render, or of a radio that is in no mesh."""
    radio = next((radio for radio in node.radios if package == "wireless" and radio.name == section), None)
    if radio is not None:
        return radio.mesh is None and option in _ACCESS_POINT_OPTIONS
    return _RENDERED.fullmatch(section) is None


@fleet_rule(
    "MC530",
    Severity.WARNING,
    "A VLAN port has no switch VLAN",
    why="""A port such as eth0.1 leads through a switch that swconfig drives, and /etc/config/network defines which
    switch ports belong to the VLAN. A provisioned node keeps its definition; an image built from the rendered files has
    none: after its first boot the wired ports are dead.""",
    fix="""Copy the `switch_vlan` sections from a new device's /etc/config/network to `switch_vlans` of the hardware:
    `{1: "3 0t", 2: "2 0t"}`. If the VLAN belongs to an external switch, suppress this finding.""",
    failing="hardware: {rocket: {lan_ports: [eth0.1]}}",
    passing="hardware: {rocket: {lan_ports: [eth0.1], switch_vlans: {1: 3 0t}}}",
)
def vlan_without_switch(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        vlans = [vlan for vlan, _ in node.hardware.switch_vlans]
        is_own = node.lan_ports != node.hardware.lan_ports
        place = ("nodes", node.name) if is_own else ("hardware", node.hardware.name)
        for port in node.unswitched_ports:
            path = (*place, "lan_ports", str(node.lan_ports.index(port)))
            expected = f"VLAN {port.rpartition('.')[2]} in switch_vlans"
            yield Finding(
                path, f"no switch VLAN for {port}", expected, f"VLANs {join_limited(vlans)}" if vlans else "none"
            )


_LIDAR = "robots: {husky1: {computers: {lidar: {address: 10.42.0.60/24}}}}\n"


@fleet_rule(
    "MC531",
    Severity.WARNING,
    "Broadcasts of a robot's devices can reach the air",
    why="""The radio bridges the robot's switch into the mesh. Many sensors broadcast until they are configured (lidars,
    to 255.255.255.255): one such device fills the channel of the whole team, at the multicast rate, repeated by every
    node, and no priority in the computers helps.""",
    fix="""Set `lan_filter: {}` on the radio, its group or in `defaults`, with `udp_ports` for the broadcasts that other
    robots need; or give the robot a `lan` of its own, which is routed.""",
    failing=_LIDAR,
    passing=_LIDAR + "nodes: {husky1-front: {lan_filter: {}}}",
)
def broadcasts_unfiltered(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        nodes = [fleet.nodes[name] for name in robot.nodes if name in fleet.nodes]
        open_ones = [node.name for node in nodes if node.state.is_managed and node.bridges_lan and not node.lan_filter]
        if robot.computers and open_ones:
            message = f"{join_limited(open_ones)} bridges the broadcasts of {join_limited(list(robot.computers))}"
            yield Finding(("robots", robot.name, "computers"), message, "a LAN filter", "none")


@fleet_rule(
    "MC532",
    Severity.WARNING,
    "A LAN filter has nothing to filter",
    why="""A radio that routes its LAN, or has no wired ports or no mesh, bridges no frames: the filter is not
    installed, and the entry suggests a protection that does not exist.""",
    fix="Remove `lan_filter` from this node; `lan_filter: null` removes that of a group or of `defaults`.",
    failing="nodes: {b01: {lan_ports: [], lan_filter: {}}}",
    passing="nodes: {b01: {lan_ports: [eth0], lan_filter: {}}}",
)
def filter_without_bridge(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        # inherited from `defaults`, it is right for the nodes that do bridge
        written = fleet.where("nodes", node.name, "lan_filter").layer
        if node.lan_filter is not None and not node.bridges_lan and written != "defaults":
            yield Finding(("nodes", node.name, "lan_filter"), "it bridges nothing", "a bridged LAN", "none")


@fleet_rule(
    "MC533",
    Severity.WARNING,
    "A switch port is untagged in two VLANs",
    why="""Frames without a tag that enter the port belong to one VLAN only, the port's own (PVID): what is connected
    there hears both VLANs and reaches one, or the WAN and the LAN are one network.""",
    fix="List the port in one of them, or tagged (`5t`) in one.",
    failing="hardware: {rocket: {lan_ports: [eth0.1], switch_vlans: {1: 2 3 0t, 2: 1 3 0t}}}",
    passing="hardware: {rocket: {lan_ports: [eth0.1], switch_vlans: {1: 2 3 0t, 2: 1 3t 0t}}}",
)
def untagged_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        untagged = [(port, vlan) for vlan, ports in profile.switch_vlans for port in ports.split() if port.isdigit()]
        for port, (first, *later) in duplicates(untagged):
            for vlan in later:
                path = ("hardware", profile.name, "switch_vlans", vlan)
                yield Finding(path, f"port {port} is untagged in VLAN {first} as well", f"{port} in one of them", port)


@fleet_rule(
    "MC534",
    Severity.WARNING,
    "A VLAN port's VLAN has no tagged port",
    why="""The processor sends and receives eth0.1 with the tag of VLAN 1. Where the switch's port to the processor is
    untagged in that VLAN, eth0.1 receives nothing: the wired ports are dead.""",
    fix="Tag the processor's port, `0t` on most boards, as in the device's own /etc/config/network.",
    failing="hardware: {rocket: {lan_ports: [eth0.1], switch_vlans: {1: 3 0}}}",
    passing="hardware: {rocket: {lan_ports: [eth0.1], switch_vlans: {1: 3 0t}}}",
)
def vlan_without_tag(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        bridged = {port.rpartition(".")[2]: port for port in profile.lan_ports if "." in port}
        for vlan, ports in profile.switch_vlans:
            if vlan in bridged and "t" not in ports:
                path = ("hardware", profile.name, "switch_vlans", vlan)
                yield Finding(path, f"no tagged port for {bridged[vlan]}", "the processor's port, such as 0t", ports)
