"""`meshctl lab`: a virtual fleet on this machine; `links` has the commands for its links."""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.cli.context import AsJson, LabDirectory, lab_directory
from meshctl.cli.output import echo, echo_json, terminal_width, write_file
from meshctl.device.framing import command_line
from meshctl.errors import InputError
from meshctl.model import Backend, Fleet, Release
from meshctl.report import text_table
from meshctl.resources import shipped
from meshctl.wording import counted
from meshlab.cli import links, sweep
from meshlab.console import run_shell
from meshlab.errors import LabError
from meshlab.faults import FAULTS, describe, parse
from meshlab.fleet import QemuFleet, VirtualFleet, stop_fleet
from meshlab.from_inventory import spec_of
from meshlab.images import firmware_image
from meshlab.inventory_copy import copy_inventory
from meshlab.releases import facts

app = typer.Typer(help="A virtual fleet on this machine.", no_args_is_help=True)

# seconds for each node to boot on a busy machine, and for the first one to start
_BOOT_S = 2.0
_START_S = 60.0
# the same under emulation: packages are downloaded, and the kernel boots, at worst twice
_REAL_BOOT_S = 10.0
_REAL_START_S = 600.0

Where = Annotated[str, typer.Argument(help="A node (b03) or a link (b01-b02).")]


@app.command("up")
def up(
    inventory: Annotated[Path | None, typer.Argument(help="The fleet to copy; default: the example lab.")] = None,
    chosen: Annotated[Path | None, typer.Option("--inventory", "-i", help="Same as the argument.")] = None,
    nodes: Annotated[int | None, typer.Option("--nodes", min=1, help="Use only the first N nodes.")] = None,
    directory: LabDirectory = None,
    port: Annotated[int, typer.Option("--port", help="TCP port of all nodes; 0: any free port.")] = 0,
    real: Annotated[
        bool, typer.Option("--real", help="Run in a QEMU machine with the kernel's own 802.11 radios and batman-adv.")
    ] = False,
) -> None:
    """Start a fleet of factory-fresh OpenWrt-like nodes, as the inventory describes them.

    Example: meshctl lab up inventory/lab --nodes 6 --real
    """
    if inventory is not None and chosen is not None:
        raise InputError("expected one inventory, found an argument and --inventory; use one of them")
    place = lab_directory(directory)
    copy = copy_inventory(inventory or chosen or shipped("inventory") / "lab", place)
    spec = spec_of(copy.fleet, links=copy.links, nodes=nodes, port=port)
    if real:
        echo("starting a QEMU machine with the kernel's radios; the first start builds its image")
        fleet: VirtualFleet = QemuFleet(spec, place).up(wait_s=_REAL_START_S + _REAL_BOOT_S * len(spec.nodes))
    else:
        fleet = VirtualFleet(spec, place).up(wait_s=_START_S + _BOOT_S * len(spec.nodes))
    verb = "is" if len(spec.nodes) == 1 else "are"
    echo(f"{counted(len(spec.nodes), 'node')} of {spec.name} {verb} up, each at 192.168.1.1 on its own bench port")
    if copy.kept is not None:
        echo(f"kept:      {copy.kept}, the earlier copy of the inventory, which was edited")
    echo(f"inventory: {copy.inventory}")
    if copy.hosts:
        computers = counted(len(copy.hosts), "computer")
        echo(f"removed:   ssh.host of {computers}, in this copy only: no command reaches the real robots")
    lab, inventory_path = shlex.quote(str(place)), shlex.quote(str(copy.inventory))
    echo(f"use it:    export MESHCTL_LAB={lab} MESHCTL_INVENTORY={inventory_path}")
    echo(f"console:   meshctl lab shell {fleet.spec.names[0]}")
    for line in next_steps(copy.fleet):
        echo(line)


def next_steps(fleet: Fleet) -> list[str]:
    """The commands to run after `lab up`. The nodes of a mesh that the lab cannot route stay on the bench."""
    unrouted = [mesh.name for mesh in fleet.meshes.values() if mesh.backend is Backend.MESHMERIZE]
    if not unrouted:
        return ["next:      meshctl bootstrap --yes; meshctl lab unplug; meshctl topology"]
    meshes = f"mesh{'es' if len(unrouted) > 1 else ''} {', '.join(unrouted)}"
    return [
        f"note:      the lab does not route meshmerize: without its cable, no node of {meshes} is reached",
        "next:      meshctl bootstrap --yes; meshctl topology",
    ]


@app.command("down")
def down(directory: LabDirectory = None) -> None:
    """Stop the fleet; its directory stays, with flash contents and logs.

    Example: meshctl lab down
    """
    place = lab_directory(directory)
    name = stop_fleet(place)
    if not name:
        raise LabError(f"no virtual fleet runs in {place}", hint="run `meshctl lab up` to start one")
    echo(f"{name} is down")


@app.command("status")
def status(directory: LabDirectory = None, as_json: AsJson = False) -> None:
    """Show every node's power, release, addresses and faults.

    Example: meshctl lab status --json
    """
    state = VirtualFleet.attach(lab_directory(directory)).status()
    if as_json:
        echo_json(json.dumps(state, indent=2))
        return
    echo(f"{state['fleet']}: process {state['pid']}, port {state['port']}")
    head = ("NODE", "POWER", "RELEASE", "ADDRESS", "PLUGGED", "MESH", "REACHED AT", "FAULTS")
    rows = [_row(node) for node in state["nodes"]]
    leave_out = ("RELEASE", "REACHED AT", "PLUGGED", "FAULTS")
    for line in text_table.lines(head, rows, terminal_width(sys.stdout), leave_out=leave_out):
        echo(line)
    for link in state["links"]:
        if not link["up"]:
            echo(f"link {'-'.join(link['between'])} is down")


@app.command("shell")
def shell(
    node: Annotated[str, typer.Argument(help="Name of the node.")],
    command: Annotated[list[str] | None, typer.Argument(help="A command; default: an interactive shell.")] = None,
    directory: LabDirectory = None,
) -> None:
    """Open a node's serial console, which does not need its network. Commands are quoted as for `meshctl run`.

    Example: meshctl lab shell b01 -- uci show network
    """
    fleet = VirtualFleet.attach(lab_directory(directory))
    raise typer.Exit(run_shell(fleet, fleet.node(node).name, command_line(command) if command else ""))


_BREAK_HELP = "\n\n".join(
    (
        "Inject a fault, now or at a step; `meshctl lab mend` repairs it.",
        *(f"{fault.value}: {text}" for fault, text in FAULTS.items()),
        "Example: meshctl lab break b03 'power-cut@reload_config'",
        "Example: meshctl lab break b01-b02 link-down",
    )
)


@app.command("break", help=_BREAK_HELP)
def break_(
    where: Where,
    what: Annotated[str, typer.Argument(help="The fault; some take @STEP: power-cut@7, power-cut@flash.")],
    directory: LabDirectory = None,
) -> None:
    request = parse(what)
    VirtualFleet.attach(lab_directory(directory)).inject_fault(where, what)
    echo(f"{where}: {describe(request)}")


@app.command("mend")
def mend(
    where: Annotated[str, typer.Argument(help="A node or a link; default: everything.")] = "",
    directory: LabDirectory = None,
) -> None:
    """Repair injected faults: restore power and links, free the flash, recover dead firmware.

    Example: meshctl lab mend b03
    """
    VirtualFleet.attach(lab_directory(directory)).repair(where)
    echo(f"{where or 'everything'}: repaired")


links.register(app)
sweep.register(app)


@app.command("plug")
def plug(
    nodes: Annotated[list[str] | None, typer.Argument(help="Nodes; default: all.")] = None,
    directory: LabDirectory = None,
) -> None:
    """Connect nodes' LAN ports to this machine, as on a bench.

    Example: meshctl lab plug b01
    """
    _plug(directory, nodes, True)


@app.command("unplug")
def unplug(
    nodes: Annotated[list[str] | None, typer.Argument(help="Nodes; default: all except the base.")] = None,
    directory: LabDirectory = None,
) -> None:
    """Disconnect nodes' LAN ports: from then on they are reached only over the mesh.

    Example: meshctl lab unplug
    """
    _plug(directory, nodes, False)


@app.command("image")
def image(
    release: Annotated[Release, typer.Argument(help="Release series, such as 24.10.")],
    board: Annotated[str, typer.Argument(help="Board name, such as compex,wpj344-16m.")],
    out: Annotated[Path, typer.Argument(help="The file to write.")],
    package: Annotated[list[str] | None, typer.Option("--package", help="Package to add to the mesh packages.")] = None,
    revision: Annotated[str, typer.Option("--revision", help="Build revision; default: that of new nodes.")] = "",
    target: Annotated[
        str, typer.Option("--target", help="The hardware profile's target, such as ath79/nand.")
    ] = "ath79/generic",
) -> None:
    """Write a firmware image for virtual nodes and print its line for the inventory.

    Example: meshctl lab image 23.05 compex,wpj344-16m wpj344.bin --revision r24107-0123456789
    """
    named = revision or facts(release).revision
    content = firmware_image(release, board=board, extra=tuple(package or ()), target=target, revision=named)
    write_file(out, content)
    echo(f"firmware: {{image: {out.name}, sha256: {hashlib.sha256(content).hexdigest()}, revision: {named}}}")


def _plug(directory: Path | None, names: list[str] | None, plugged: bool) -> None:
    fleet = VirtualFleet.attach(lab_directory(directory))
    for node in (fleet.node(name) for name in names) if names else fleet.nodes:
        if names or plugged or not node.is_base:
            node.plug(plugged)
            if node.is_base and not plugged:
                echo(f"{node.name} is the base: no node is reached now, until `meshctl lab plug {node.name}`")


def _row(node: dict[str, Any]) -> tuple[str, ...]:
    return (
        node["name"],
        node["power"],
        node["release"],
        node["address"] or "-",
        "yes" if node["plugged"] else "no",
        "yes" if node["in_mesh"] else "no",
        " ".join(node["reached_at"]) or "-",
        " ".join(node["breaks"]) or "-",
    )
