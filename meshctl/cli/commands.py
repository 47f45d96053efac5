"""The table of commands: name -> module and function, with the one line that `meshctl --help` shows.

A target that names a `typer.Typer` (conventionally `app`) is a group of commands. The table is data so that the
root's help imports no command.
"""

from __future__ import annotations

from typing import NamedTuple


class Entry(NamedTuple):
    """`attribute` of `module` is the command's function, or the Typer app of a group; no module: an extension's."""

    module: str
    attribute: str
    summary: str
    panel: str = "Commands"


_INVENTORY = "Inventory"
_CHANGE = "Change the fleet"
_WATCH = "Watch and reach"
_ROBOTS = "Robots"
_LAB = "Practise"

COMMANDS: dict[str, Entry] = {
    "init": Entry("meshctl.cli.inventory", "init", "Write a commented starter inventory", _INVENTORY),
    "inventory": Entry("meshctl.cli.inventory", "app", "Show what the inventory says and why", _INVENTORY),
    "deployed": Entry("meshctl.cli.deployed", "deployed", "Mark dropped beacons as deployed", _INVENTORY),
    "schema": Entry("meshctl.cli.inventory", "schema", "Print the inventory's JSON Schema for editors", _INVENTORY),
    "lint": Entry("meshctl.cli.lint", "lint", "Check inventories across all layers", _INVENTORY),
    "render": Entry("meshctl.cli.render", "render", "Write the files each node gets", _INVENTORY),
    "diff": Entry("meshctl.cli.render", "diff", "Compare two inventories by what changes on which node", _INVENTORY),
    "plan": Entry("meshctl.cli.plan", "plan", "Show what provisioning would do, in which order, and why", _CHANGE),
    "apply": Entry("meshctl.cli.plan", "apply", "Carry out a saved plan, exactly", _CHANGE),
    "provision": Entry("meshctl.cli.plan", "provision", "Plan, ask, apply", _CHANGE),
    "resume": Entry("meshctl.cli.plan", "resume", "Take up what an earlier run left", _CHANGE),
    "history": Entry("meshctl.cli.history", "history", "Show earlier runs, steps and outcomes", _CHANGE),
    "bootstrap": Entry("meshctl.cli.bootstrap", "bootstrap", "Take factory devices into the fleet", _CHANGE),
    "replace": Entry("meshctl.cli.bootstrap", "replace", "Give a dead node's identity to a spare", _CHANGE),
    "backup": Entry("meshctl.cli.backup", "backup", "Fetch a node's whole state", _CHANGE),
    "restore": Entry("meshctl.cli.backup", "restore", "Put a node's saved state back", _CHANGE),
    "status": Entry("meshctl.cli.status", "status", "Show the whole fleet, and what is wrong with it", _WATCH),
    "preflight": Entry("meshctl.cli.status", "preflight", "Go or no-go for the run, with reasons", _WATCH),
    "topology": Entry("meshctl.cli.topology", "topology", "Draw the mesh as its nodes see it", _WATCH),
    "trust": Entry("meshctl.cli.ssh", "trust", "Pin the host keys of nodes", _WATCH),
    "run": Entry("meshctl.cli.ssh", "run", "Run a command on nodes", _WATCH),
    "ssh": Entry("meshctl.cli.ssh", "ssh", "Log in to a node", _WATCH),
    "robots": Entry("meshctl.cli.robots", "app", "Deploy and watch udp_mesh on the robots' computers", _ROBOTS),
    "lab": Entry("", "app", "A virtual fleet on this machine", _LAB),
}
