"""`meshctl inventory import device` and `import uci`: an existing device's configuration as a node of the inventory."""

from __future__ import annotations

import getpass
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from ipaddress import ip_interface
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.cli.context import AsJson, DryRun, InventoryPath, KeyFiles, Lab, Options, with_options
from meshctl.cli.input_file import read_input
from meshctl.cli.new_nodes_file import NewNodesFile, file_of_new_nodes
from meshctl.cli.output import echo, echo_json
from meshctl.cli.public_key import own_public_key
from meshctl.diagnostics import Diagnostic, Severity
from meshctl.errors import InputError
from meshctl.interchange.device import MARKER, ExistingDevice, exported_device, observed_device, release_of
from meshctl.interchange.device_differences import Fate
from meshctl.interchange.device_entries import ImportOptions, secret_path
from meshctl.interchange.device_import import DeviceImport
from meshctl.interchange.device_import import import_device as make_import
from meshctl.interchange.new_inventory import edited, edits_of, load_text, new_text
from meshctl.inventory.all_or_none import all_or_none
from meshctl.inventory.edit import Editor, FileEdit, save
from meshctl.inventory.load import load_fleet
from meshctl.inventory.secrets import SecretStore
from meshctl.lint import DiskFiles, LintContext, lint
from meshctl.model import Fleet, NodeState, Release, Role, Secret, SecretRef
from meshctl.model.ip import IpInterface
from meshctl.regdb import load as load_regdb

FLEET_FILE = "fleet.yaml"
_HEADINGS: Mapping[Fate, str] = {
    Fate.CHANGED: "provisioning would change",
    Fate.REMOVED: "provisioning would remove",
    Fate.ADDED: "provisioning would add",
}


@dataclass(frozen=True, slots=True)
class ImportTarget:
    """Where the node goes: `fleet` and `nodes_file` are the existing inventory's, None for a new one in the directory
    `new`."""

    inventory: Path
    new: Path | None
    fleet: Fleet | None
    nodes_file: Path | None
    options: ImportOptions
    keep: tuple[str, ...]
    dry_run: bool
    as_json: bool

    @property
    def file(self) -> Path:
        """The inventory's first file."""
        if self.new is not None:
            return self.new / FLEET_FILE
        return self.inventory / FLEET_FILE if self.inventory.is_dir() else self.inventory


_OPTIONS: Options = {
    "inventory": (InventoryPath, Path()),
    "new": (
        Annotated[Path | None, typer.Option("--new", metavar="DIR", help="Write a new inventory to DIR instead.")],
        None,
    ),
    "into": (NewNodesFile, None),
    "name": (
        Annotated[str, typer.Option("--name", help="Name of the node; default: the device's hostname.")],
        "",
    ),
    "address": (
        Annotated[str, typer.Option("--address", help="Management address for it, e.g. 10.42.0.20/24.")],
        "",
    ),
    "hardware": (
        Annotated[str, typer.Option("--hardware", help="Hardware profile; default: the one of its board.")],
        "",
    ),
    "role": (Annotated[Role | None, typer.Option("--role", help="Role of the node.")], None),
    "state": (Annotated[NodeState | None, typer.Option("--state", help="State of the node.")], None),
    "label": (Annotated[str, typer.Option("--label", help="Label on the device.")], ""),
    "group": (
        Annotated[list[str] | None, typer.Option("--group", help="Group of the inventory; repeatable.")],
        None,
    ),
    "keep": (
        Annotated[
            list[str] | None,
            typer.Option(
                "--keep", metavar="SECTION", help="Keep a section that meshctl does not write, e.g. 'network.wan*'."
            ),
        ],
        None,
    ),
    "fleet_name": (
        Annotated[str, typer.Option("--fleet", help="Name of a new inventory's fleet.")],
        "",
    ),
    "country": (
        Annotated[str, typer.Option("--country", help="Country of a new inventory; default: the radio's.")],
        "",
    ),
    "dry_run": (DryRun, False),
    "as_json": (AsJson, False),
}


@contextmanager
def _import_target(
    *,
    inventory: Path,
    new: Path | None,
    into: Path | None,
    name: str,
    address: str,
    hardware: str,
    role: Role | None,
    state: NodeState | None,
    label: str,
    group: list[str] | None,
    keep: list[str] | None,
    fleet_name: str,
    country: str,
    dry_run: bool,
    as_json: bool,
) -> Iterator[ImportTarget]:
    """Check the options and load the inventory. Raises InputError, InvalidInput."""
    if new is not None and ((new / FLEET_FILE).exists() or (new / FLEET_FILE).is_symlink()):
        raise InputError(f"{new / FLEET_FILE} already exists; not overwritten", hint="choose another directory")
    if new is not None and into is not None:
        raise InputError("--file names a file of an existing inventory, and --new writes a new one: use one of them")
    if state is not None and not state.is_managed:
        raise InputError(f"--state {state.value}: a device that answers is neither lost nor retired")
    place = new if new is not None else inventory.resolve() if inventory.is_dir() else inventory.resolve().parent
    options = ImportOptions(
        name=name,
        address=_interface(address),
        hardware=hardware,
        role=role.value if role is not None else "",
        state=state.value if state is not None else "",
        label=label,
        groups=tuple(group or ()),
        fleet=fleet_name,
        country=country,
        operator_key=own_public_key(None) if new is not None else "",
        secret_file=lambda mesh: secret_path(place, mesh),
    )
    fleet = nodes_file = None
    if new is None:
        fleet = load_fleet(inventory, environ=os.environ)
        # asked before the device is: an import that cannot be written needs no login
        nodes_file = file_of_new_nodes(Editor.open(inventory, environ=os.environ), into)
    yield ImportTarget(inventory, new, fleet, nodes_file, options, tuple(keep or ()), dry_run, as_json)


def _interface(text: str) -> IpInterface | None:
    if not text:
        return None
    try:
        return ip_interface(text if "/" in text else f"{text}/{128 if ':' in text else 24}")
    except ValueError:
        expected = "an IP address with its prefix length, such as 10.42.0.20/24"
        raise InputError(f"--address {text}: expected {expected}") from None


@with_options("target", _import_target, _OPTIONS)
def import_device(
    target: ImportTarget,
    device: Annotated[
        str,
        typer.Argument(
            metavar="[USER@]HOST[:PORT]",
            help="Address of the device; in a lab also the name of a plugged-in node.",
        ),
    ],
    fingerprint: Annotated[
        str, typer.Option("--fingerprint", metavar="SHA256:...", help="Its host key's fingerprint, as printed on it.")
    ] = "",
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Accept its host key without confirmation.")] = False,
    ask_password: Annotated[bool, typer.Option("--ask-password", help="Ask for its password.")] = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Read an existing device over SSH and add it as a node. Nothing on the device is changed.

    Its options that the inventory has no key for go into `extra_uci` where that keeps their meaning. All others are
    listed: they are what provisioning would change. A mesh key goes into a new file beside the inventory's directory
    and is never printed. No file is overwritten, and a node that the inventory has is not changed.

    Example: meshctl inventory import device 192.168.1.1 --address 10.42.0.20/24 --role beacon

    Example: meshctl inventory import device root@10.42.0.11 --new my-fleet
    """
    from meshctl.cli.device_login import read_device

    password = Secret(getpass.getpass(f"password on {device}: ")) if ask_password else None
    observation, host_key = read_device(
        device,
        key_files=tuple(key or ()),
        lab=lab,
        fingerprint=fingerprint,
        yes=yes,
        password=password,
        paths=(MARKER,),
    )
    with_key = replace(target, options=replace(target.options, host_key=host_key))
    _import(with_key, observed_device(observation), device)


@with_options("target", _import_target, _OPTIONS)
def import_export(
    target: ImportTarget,
    file: Annotated[str, typer.Argument(metavar="FILE", help="Output of `uci export`; - for standard input.")],
    release: Annotated[str, typer.Option("--release", help="OpenWrt release of the device, e.g. 24.10.")] = "",
    board: Annotated[
        str, typer.Option("--board", help="Its board name, e.g. ubnt,rocket-m; not needed with --hardware.")
    ] = "",
    openwrt_target: Annotated[str, typer.Option("--target", help="Its OpenWrt target, e.g. ath79/generic.")] = "",
) -> None:
    """Add a node from a recorded `uci export`, which contains neither board nor release.

    Example: meshctl inventory import uci b07.uci --hardware rocket
    """
    profiles = {} if target.fleet is None else target.fleet.hardware
    profile = profiles.get(target.options.hardware)
    if profile is None and not (release and board):
        if profiles and target.options.hardware:
            raise InputError(
                f"no hardware profile {target.options.hardware!r}: expected one of {', '.join(profiles)}",
                hint="or pass --release and --board for a new one",
            )
        raise InputError(
            "expected --release and --board, which `uci export` does not contain",
            hint="or name a hardware profile of the inventory with --hardware",
        )
    known: Release | None = release_of(release) if release else None
    source = read_input(file)
    device = exported_device(
        source.text,
        source.file,
        release=known or (profile.release if profile else Release.V24_10),
        board=board or (profile.board if profile else ""),
        target=openwrt_target or (profile.target if profile else ""),
    )
    _import(target, device, source.file)


def _import(target: ImportTarget, device: ExistingDevice, source: str) -> None:
    load, secrets = _loader(target, source), _secrets(target.fleet)
    made = make_import(device, target.fleet, target.options, load, secrets, keep=target.keep)
    edits = () if target.new is not None else edits_of(target.inventory, os.environ, made.values, target.nodes_file)
    text = new_text(made.values, source, made.assumed) if target.new is not None else ""
    files = _secret_files(target, made)
    errors = _lint_errors(target, made)
    if not target.dry_run:
        _write(target, text, edits, files)
    if target.as_json:
        echo_json(json.dumps(_as_json(target, made, files, errors), indent=2))
    else:
        _show(target, device, made, text, edits, files, errors)


def _loader(target: ImportTarget, source: str) -> Callable[[Mapping[tuple[str, ...], Any]], Fleet]:
    if target.new is not None:
        return lambda values: load_text(target.file, new_text(values, source))
    return lambda values: edited(target.inventory, os.environ, values, target.nodes_file).fleet()


def _secrets(fleet: Fleet | None) -> Callable[[SecretRef], Secret]:
    store = SecretStore(os.environ, Path(fleet.base if fleet is not None else "."))
    return lambda ref: store.get(ref)


def _secret_files(target: ImportTarget, made: DeviceImport) -> dict[Path, Secret]:
    """The files for the keys of new meshes. Raises InputError for one that exists with other content."""
    bases = {
        mesh.key.where: mesh.key.base for mesh in made.fleet.meshes.values() if mesh.key is not None and mesh.key.where
    }
    files = {}
    for written, secret in made.secrets.items():
        path = Path(os.path.normpath(Path(bases.get(written) or target.file.parent, written)))
        if path.exists() or path.is_symlink():
            raise InputError(
                f"{path} already exists; the mesh's key was not written and nothing was changed",
                hint="remove that file, if it is of an earlier attempt",
            )
        files[path] = secret
    return files


def _lint_errors(target: ImportTarget, made: DeviceImport) -> tuple[Diagnostic, ...]:
    """New errors that `meshctl lint` will report."""
    context = LintContext(load_regdb(), DiskFiles())
    errors = tuple(each for each in lint(made.fleet, context) if each.severity is Severity.ERROR)
    if not errors or target.fleet is None:
        return errors
    known = {(each.code, each.path) for each in lint(target.fleet, context)}
    return tuple(each for each in errors if (each.code, each.path) not in known)


def _write(target: ImportTarget, text: str, edits: tuple[FileEdit, ...], files: Mapping[Path, Secret]) -> None:
    """Write the secrets, then the inventory; a failure or Ctrl-C removes the new files. Raises InputError."""
    with all_or_none(target.file) as new_files:
        for path, secret in files.items():
            new_files.create(path, (secret.reveal() + "\n").encode(), mode=0o600)
        if target.new is not None:
            new_files.create(target.file, text.encode())
        else:
            save(edits)


def _show(
    target: ImportTarget,
    device: ExistingDevice,
    made: DeviceImport,
    text: str,
    edits: tuple[FileEdit, ...],
    files: Mapping[Path, Secret],
    errors: tuple[Diagnostic, ...],
) -> None:
    echo(f"{made.name}: {device.board}, OpenWrt {device.release}")
    if target.dry_run and target.new is not None:
        echo(text, nl=False)
    for edit in edits:
        echo(edit.diff(), nl=False)
    _list("kept in extra_uci", [f"{key}: {value}" for key, value in made.kept.items()])
    for fate, heading in _HEADINGS.items():
        _list(heading, [difference.line for difference in made.of(fate)])
    _list("not written by meshctl, stays on the device", [", ".join(made.untouched)] if made.untouched else [])
    _list("not UCI, not mapped, stays on the device", list(made.unreadable))
    _list("assumed, to be checked", list(made.assumed))
    _list("to be set before provisioning", [f"{each.text} [{each.code}]. {each.hint}" for each in errors])
    if target.dry_run:
        return
    for path in files:
        echo(f"wrote {path} (the mesh's key)")
    if target.new is not None:
        echo(f"wrote {target.file}")
    shown = target.new if target.new is not None else target.inventory
    echo(f"next: `meshctl lint -i {shown}`, then `meshctl plan {made.name} -i {shown}`", err=True)


def _list(heading: str, lines: list[str]) -> None:
    if lines:
        echo(f"{heading}:")
        for line in lines:
            echo(f"  {line}")


def _as_json(
    target: ImportTarget, made: DeviceImport, files: Mapping[Path, Secret], errors: tuple[Diagnostic, ...]
) -> dict[str, Any]:
    return {
        "node": made.name,
        "file": str(target.file),
        "written": not target.dry_run,
        "entries": {".".join(path): value for path, value in made.values.items()},
        "extra_uci": dict(made.kept),
        "differences": [
            {
                "fate": each.fate.value,
                "key": each.key,
                "device": each.on_device,
                "rendered": each.rendered,
                "reason": each.reason,
            }
            for each in made.differences
        ],
        "untouched": list(made.untouched),
        "unreadable": list(made.unreadable),
        "assumed": list(made.assumed),
        "secret_files": [str(path) for path in files],
        "lint_errors": [
            {"code": each.code, "path": each.path, "text": each.text, "hint": each.hint} for each in errors
        ],
    }
