"""A report on a fleet and its nodes, for the output of a failed test."""

from __future__ import annotations

import json
from collections.abc import Iterable

from meshctl.errors import MeshctlError
from meshlab.fleet import VirtualFleet, VirtualNode
from meshlab.state import Power

_CONSOLE_LINES = 40
# the stacks of two CPUs, after a lockup of a machine's kernel
_LOG_LINES = 160
# the maximum number of nodes to describe
_NODES = 12
_COMMAND_S = 20.0
# a node's shell may hang, so it is used last and with a short timeout
_LOOK = "uptime; logread | tail -n 20; ps"
# the supervisor's log; a QEMU machine logs to its console
_LOGS = ("log", "console", "qemu.log")


def fleets_of(values: Iterable[object]) -> list[VirtualFleet]:
    """The fleets among a test's fixtures: a fleet, a node's fleet, or the `fleet` attribute of a fixture."""
    found: dict[int, VirtualFleet] = {}
    for value in values:
        fleet = value._fleet if isinstance(value, VirtualNode) else getattr(value, "fleet", value)
        if isinstance(fleet, VirtualFleet):
            found[id(fleet)] = fleet
    return list(found.values())


def report(fleet: VirtualFleet, failure: str) -> str:
    """One line per node; console, log and processes of nodes that are not up or that `failure` names (if none: of all);
    the end of the fleet's own logs."""
    parts = [f"fleet {fleet.spec.name} in {fleet.directory}"]
    try:
        nodes = fleet.status()["nodes"]
    except MeshctlError as error:
        nodes = []
        parts.append(f"it does not answer: {error}")
    parts += [json.dumps({key: node[key] for key in ("name", "power", "reason", "boots", "breaks")}) for node in nodes]
    odd = [node for node in nodes if node["power"] != Power.UP.value or node["name"] in failure]
    for node in (odd or nodes)[:_NODES]:
        parts.append(_node(fleet.node(node["name"]), is_running=bool(node["pid"])))
    for name in _LOGS:
        file = fleet.directory / name
        if file.exists():
            lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
            parts.append("\n".join([f"--- {name}", *lines[-_LOG_LINES:]]))
    return "\n".join(parts)


def _node(node: VirtualNode, *, is_running: bool) -> str:
    parts = [f"--- {node.name}: console"]
    try:
        parts.append(node.console(_CONSOLE_LINES))
        if is_running:
            done = node.exec(_LOOK, timeout_s=_COMMAND_S)
            parts += [f"--- {node.name}: log and processes", done.stdout + done.stderr]
    except MeshctlError as error:
        parts.append(f"(it does not answer: {error})")
    return "\n".join(parts)
