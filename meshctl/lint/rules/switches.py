"""Names of ports, and ports of boards with a switch that swconfig drives (MC535 to MC536)."""

from __future__ import annotations

import re
from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.bridge import port_lists
from meshctl.model import Fleet
from meshctl.wording import join_limited

# names of OpenWrt's ports in the wrong case, and those that systemd gives on other distributions
_WRONG_CASE = re.compile(r"(?:eth|lan|wan|ethernet|port|sfp|usb)[0-9]*(?:\.[0-9]+)?", re.IGNORECASE)
_OF_SYSTEMD = re.compile(r"en(?:o[0-9]|s[0-9]|p[0-9]+s[0-9]|x[0-9a-f]{12}).*")


@fleet_rule(
    "MC535",
    Severity.WARNING,
    "No bridged port is a VLAN of the switch",
    why="""`switch_vlans` sends the frames of each VLAN tagged to the processor: they arrive at `eth0.1`, and at `eth0`
    itself arrives nothing. With `lan_ports: [eth0]` the wired ports are dead, and the operator at the base's port, or a
    robot's computer, is cut off.""",
    fix="List the VLAN's port, such as `eth0.1`, as /etc/board.json on the device does; or remove `switch_vlans`.",
    failing="hardware: {rocket: {lan_ports: [eth0], switch_vlans: {1: 3 0t, 2: 2 0t}}}",
    passing="hardware: {rocket: {lan_ports: [eth0.1], switch_vlans: {1: 3 0t, 2: 2 0t}}}",
)
def port_beside_switch(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        vlans = [f"eth0.{vlan}" for vlan, ports in node.hardware.switch_vlans if "t" in ports]
        if not vlans or not node.lan_ports or any("." in port for port in node.lan_ports):
            continue
        if any(not port.startswith("eth") for port in node.lan_ports):
            continue  # a board whose ports have interfaces of their own
        is_own = node.lan_ports != node.hardware.lan_ports
        place = ("nodes", node.name) if is_own else ("hardware", node.hardware.name)
        message = "the switch sends it tagged frames only"
        yield Finding(
            (*place, "lan_ports", "0"), message, f"one of {join_limited(vlans)}", join_limited(node.lan_ports)
        )


@fleet_rule(
    "MC536",
    Severity.WARNING,
    "A port has no name of OpenWrt's",
    why="""Names of interfaces are case-sensitive, and OpenWrt's are in lower case: `eth0`, `lan1`, `wan`. It does not
    use systemd's names either, such as `enp1s0`. netifd ignores a port that does not exist: the wired port stays out
    of the bridge, and the operator at the base's port, or a robot's computer, is cut off.""",
    fix="List the ports as /etc/board.json on the device has them. If the device has this name, suppress this finding.",
    failing="hardware: {rocket: {lan_ports: [ETH0]}}",
    passing="hardware: {rocket: {lan_ports: [eth0]}}",
)
def port_name(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for place, ports in port_lists(fleet):
        for index, port in enumerate(ports):
            if _WRONG_CASE.fullmatch(port) and not port.islower():
                yield Finding((*place, str(index)), "names are case-sensitive", port.lower(), port)
            elif _OF_SYSTEMD.fullmatch(port):
                yield Finding((*place, str(index)), "a name of systemd", "a port such as eth0 or lan1", port)
