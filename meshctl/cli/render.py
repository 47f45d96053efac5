"""`meshctl render` and `meshctl diff`: the files of each node, and the changes between two inventories."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.cli.context import AsJson, InventoryPath, Limit, Nodes, read_selection
from meshctl.cli.git_revision import checkout
from meshctl.cli.output import echo, echo_json
from meshctl.errors import ExitCode
from meshctl.inventory import load_fleet
from meshctl.inventory.secrets import SecretStore
from meshctl.inventory.selection import LIST_HINT, attributes_of, select
from meshctl.model import Fleet, Secret, SecretRef
from meshctl.render import Rendered, render_nodes
from meshctl.render.compare import NodeChange, NodeDifference, compare_fleets
from meshctl.render.imagebuilder import ImageFolder, folder_files, image_folders
from meshctl.render.write import write_folder, write_node


def render(
    nodes: Nodes = None,
    limit: Limit = None,
    inventory: InventoryPath = Path(),
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write each node's files to DIR/NODE/.")
    ] = None,
    imagebuilder: Annotated[
        Path | None,
        typer.Option("--imagebuilder", metavar="DIR", help="Write ImageBuilder overlays and build scripts to DIR."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Render each node's configuration files; without --out or --imagebuilder, print them with secrets masked.

    Example: meshctl render 'husky1-*' --out build/
    """
    fleet = load_fleet(inventory, environ=os.environ)
    # render all before writing any: a fleet is written completely or not at all
    rendered = render_nodes(fleet, _selected_names(fleet, nodes or [], limit or []), _secrets(fleet))
    folders = {item.node: write_node(item, out) for item in rendered} if out is not None else {}
    builds = (
        [(item, _write_build(item, imagebuilder)) for item in image_folders(fleet, rendered)] if imagebuilder else []
    )
    if imagebuilder:
        _warn_of_dead_ports(fleet, rendered)
    if as_json:
        echo_json(json.dumps(_report(rendered, folders, builds), indent=2, ensure_ascii=False))
    elif out is None and imagebuilder is None:
        echo("".join(f"### {item.node} ({item.release})\n{item.masked_text}" for item in rendered), nl=False)
    else:
        for node, folder in folders.items():
            echo(f"{node}: {folder}")
        for build, folder in builds:
            echo(f"{build.name}: cd IMAGEBUILDER && sh {(folder / 'build.sh').resolve()}")


def _warn_of_dead_ports(fleet: Fleet, rendered: Iterable[Rendered]) -> None:
    """An image has its own /etc/config/network, so its first boot does not write the switch layout."""
    dead = {item.node: fleet.nodes[item.node].unswitched_ports for item in rendered}
    for node, ports in dead.items():
        if ports:
            echo(
                f"warning: {node}: {', '.join(ports)} may have no port in this image: "
                "its hardware has no switch_vlans in the inventory (MC530)",
                err=True,
            )


def _secrets(fleet: Fleet) -> Callable[[SecretRef], Secret]:
    store = SecretStore(os.environ, Path(fleet.base))
    return lambda ref: store.get(ref)


def _selected_names(fleet: Fleet, patterns: Iterable[str], limits: Iterable[str]) -> list[str]:
    """The nodes that match any pattern and every limit, in inventory order. Raises InputError for no match."""
    wanted = list(patterns)
    candidates = {name: attributes_of(node) for name, node in fleet.nodes.items()}
    chosen = select(wanted, candidates, read_selection, limits, what="node", hint=LIST_HINT)
    # patterns skip unmanaged nodes; an exact name reports why it cannot be rendered
    return [name for name in chosen if name in wanted or fleet.nodes[name].state.is_managed]


def _write_build(folder: ImageFolder, out: Path) -> Path:
    return write_folder(folder_files(folder), out / folder.name, marker="build.sh")


def _report(
    rendered: Iterable[Rendered], folders: dict[str, Path], builds: list[tuple[ImageFolder, Path]]
) -> dict[str, Any]:
    return {
        "nodes": [
            {
                "node": item.node,
                "release": item.release,
                "config_hash": item.config_hash,
                "packages": list(item.packages),
                "removed_packages": list(item.removed_packages),
                "folder": str(folders[item.node]) if item.node in folders else None,
                "files": [
                    {"path": f"/{file.path}", "mode": f"{file.mode:04o}", "content": file.masked} for file in item.files
                ],
            }
            for item in rendered
        ],
        "imagebuilder": [
            {
                "name": build.name,
                "release": str(build.release),
                "target": build.hardware.target,
                "profile": build.hardware.profile,
                "folder": str(folder),
                "calls": {item.node: build.make_call(item) for item in build.overlays},
            }
            for build, folder in builds
        ],
    }


def diff(
    before: Annotated[str, typer.Argument(metavar="A", help="Inventory, or REVISION:PATH in git.")],
    after: Annotated[
        str | None, typer.Argument(metavar="B", help="Inventory, or REVISION:PATH in git; default: the inventory.")
    ] = None,
    inventory: InventoryPath = Path(),
    as_json: AsJson = False,
) -> None:
    """Show per-node changes between two inventories; exit with 1 if there are any. Needs no secrets.

    Example: meshctl diff HEAD~1:inventory/subt-final inventory/subt-final
    """
    with checkout(before) as old, checkout(str(inventory) if after is None else after) as new:
        differences = list(compare_fleets(load_fleet(old, environ=os.environ), load_fleet(new, environ=os.environ)))
    if as_json:
        echo_json(json.dumps({"nodes": [_as_json(item) for item in differences]}, indent=2, ensure_ascii=False))
    else:
        for item in differences:
            _show(item)
    if differences:
        raise typer.Exit(int(ExitCode.FINDINGS))


def _show(difference: NodeDifference) -> None:
    if difference.change is not NodeChange.CHANGED:
        echo(f"{difference.node}: {difference.change.value}")
        return
    echo(f"{difference.node}:")
    old, new = difference.release
    if old != new:
        echo(f"  release {old} -> {new}")
    for file in difference.files:
        mark = "" if file.change is NodeChange.CHANGED else f" ({file.change.value})"
        echo(f"  /{file.path}{mark}")
        for line in file.lines:
            echo(f"    {line}")
    for sign, packages in (("+", difference.packages_added), ("-", difference.packages_removed)):
        for package in packages:
            echo(f"  {sign} package {package}")


def _as_json(difference: NodeDifference) -> dict[str, Any]:
    return {
        "node": difference.node,
        "change": difference.change.value,
        "release": {"before": difference.release[0], "after": difference.release[1]},
        "files": [
            {"path": f"/{file.path}", "change": file.change.value, "lines": list(file.lines)}
            for file in difference.files
        ],
        "packages": {"added": list(difference.packages_added), "removed": list(difference.packages_removed)},
    }
