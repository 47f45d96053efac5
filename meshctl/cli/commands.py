"""The table of commands: name -> module, function and the line that `meshctl --help` shows.

A target that is a `typer.Typer` (by convention `app`) is a group of commands. The table is data so that
`meshctl --help` imports no command.
"""

from __future__ import annotations

from typing import NamedTuple


class Entry(NamedTuple):
    """`attribute` of `module` is a function or, for a group, a Typer app; without `module` it is an extension.

    `heading` is the section of `meshctl --help`, whose commands follow one another.
    """

    module: str
    attribute: str
    summary: str
    heading: str


_INVENTORY = "Inventory"
_CHANGE = "Change the fleet"
_INSPECT = "Inspect and connect"
_ROBOTS = "Robots"
_SITES = "Sites"
_LAB = "Lab"
_HELP = "Help"

COMMANDS: dict[str, Entry] = {
    "init": Entry("meshctl.cli.inventory", "init", "Create a commented starter inventory", _INVENTORY),
    "inventory": Entry("meshctl.cli.inventory", "app", "Show and edit the inventory", _INVENTORY),
    "deployed": Entry("meshctl.cli.deployed", "deployed", "Mark beacons as deployed", _INVENTORY),
    "schema": Entry("meshctl.cli.inventory", "schema", "Print the JSON Schema of the inventory", _INVENTORY),
    "lint": Entry("meshctl.cli.lint", "lint", "Check inventories for errors and risks", _INVENTORY),
    "render": Entry("meshctl.cli.render", "render", "Render each node's configuration files", _INVENTORY),
    "diff": Entry("meshctl.cli.render", "diff", "Show per-node changes between two inventories", _INVENTORY),
    "plan": Entry("meshctl.cli.plan", "plan", "Show what provisioning would change", _CHANGE),
    "apply": Entry("meshctl.cli.plan", "apply", "Apply a saved plan", _CHANGE),
    "provision": Entry("meshctl.cli.plan", "provision", "Plan, confirm and apply changes", _CHANGE),
    "resume": Entry("meshctl.cli.plan", "resume", "Resume an interrupted run", _CHANGE),
    "rollback": Entry("meshctl.cli.rollback", "rollback", "Undo the configuration changes of a run", _CHANGE),
    "history": Entry("meshctl.cli.history", "history", "Show past runs, their steps and outcomes", _CHANGE),
    "bootstrap": Entry("meshctl.cli.bootstrap", "bootstrap", "Set up factory-default devices", _CHANGE),
    "replace": Entry("meshctl.cli.bootstrap", "replace", "Replace a failed node with a spare", _CHANGE),
    "backup": Entry("meshctl.cli.backup", "backup", "Back up a node's configuration", _CHANGE),
    "restore": Entry("meshctl.cli.backup", "restore", "Restore a node from a backup", _CHANGE),
    "status": Entry("meshctl.cli.status", "status", "Show the fleet's state and alarms", _INSPECT),
    "preflight": Entry("meshctl.cli.status", "preflight", "Run the go/no-go checks before a mission", _INSPECT),
    "topology": Entry("meshctl.cli.topology", "topology", "Show the mesh topology", _INSPECT),
    "meter": Entry("meshctl.cli.meter", "meter", "Show when a robot should drop its next beacon", _INSPECT),
    "plan-placement": Entry("meshctl.cli.plan_placement", "plan_placement", "Plan beacons along a route", _INSPECT),
    "monitor": Entry("meshctl.cli.monitor", "monitor", "Watch the fleet and serve a live page", _INSPECT),
    "alarms": Entry("meshctl.cli.alarms", "app", "List, acknowledge and silence alarms", _INSPECT),
    "metrics": Entry("meshctl.cli.metrics", "metrics", "Print the fleet's metrics for Prometheus", _INSPECT),
    "trust": Entry("meshctl.cli.ssh", "trust", "Pin the SSH host keys of nodes", _INSPECT),
    "run": Entry("meshctl.cli.ssh", "run", "Run a shell command on nodes", _INSPECT),
    "ssh": Entry("meshctl.cli.ssh", "ssh", "Log in to a node", _INSPECT),
    "robots": Entry("meshctl.cli.robots", "app", "Deploy and manage udp_mesh on robots", _ROBOTS),
    "sites": Entry("meshctl.cli.sites", "app", "Install and monitor the workers of sites", _SITES),
    "worker": Entry("meshctl.cli.worker", "worker", "Serve a site (started by other commands)", _SITES),
    "lab": Entry("", "app", "Run a virtual fleet on this machine", _LAB),
    "help": Entry("meshctl.cli.help", "help_command", "Show the help of a command", _HELP),
}
