"""Files that an inventory names outside its own folder, for a copy of that folder.

From the copy, `../packages/batctl.ipk` is another file. `bring_includes` copies included files and writes the includes
anew; `outside_references` gives every other such path: absolute, or of a copy for folders of templates, which are read
only from the inventory's tree.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from meshctl.file_access import located
from meshctl.inventory.compose import compose
from meshctl.inventory.file_paths import file_path
from meshctl.inventory.include import read_files
from meshctl.inventory.source import Source
from meshctl.inventory.text_edit import replace_value
from meshctl.inventory.tree import MappingNode, Scalar, SequenceNode
from meshctl.model import Fleet, SecretKind, SecretRef

# in the copy: what comes from outside the inventory's folder
_FOLDER = "from-outside"
_BOM = "\ufeff"

Place = tuple[str, ...]


def bring_includes(source: Path, folder: Path, target: Path, environ: Mapping[str, str]) -> None:
    """Copy the included files that are outside `folder` into its copy `target`, and include the copies instead."""
    home = folder.resolve()
    files = [file.resolve() for file in read_files(source, environ).files]
    copies = {file: target / file.relative_to(home) for file in files if file.is_relative_to(home)}
    outside = [file for file in files if file not in copies]
    copies |= {file: target / _FOLDER / f"{number}-{file.name}" for number, file in enumerate(outside, 1)}
    for file in files if outside else ():
        copies[file].parent.mkdir(parents=True, exist_ok=True)
        copies[file].write_bytes(_with_includes(file, copies, environ).encode())


def _with_includes(file: Path, copies: Mapping[Path, Path], environ: Mapping[str, str]) -> str:
    """The file's text with the copies as its includes."""
    with file.open(encoding="utf-8", newline="") as stream:
        text = stream.read().removeprefix(_BOM)
    root = compose(Source(str(file), text)).root
    includes = root.values.get("include") if isinstance(root, MappingNode) else None
    items = includes.items if isinstance(includes, SequenceNode) else ()
    for item in reversed(items):
        if isinstance(item, Scalar):
            home = environ.get("HOME", "")
            named = Path(home, item.text[2:]) if item.text.startswith("~/") else file.parent / item.text
            copy = copies.get(named.resolve())
            if copy is not None:
                text = replace_value(text, item, os.path.relpath(copy, copies[file].parent), None)
    return text


def outside_references(fleet: Fleet, folder: Path, target: Path) -> Iterator[tuple[Place, str]]:
    """Where the inventory refers to existing files by a path that is another one from its copy `target`, and the path
    to write instead."""
    home = folder.resolve()
    for place, path in _references(fleet):
        real = path.resolve()
        is_moved = not Path(fleet.where(*place).position.file).resolve().is_relative_to(home)
        # one that is not there may be meant to be made beside the copy
        if path.exists() and (is_moved or not real.is_relative_to(home)):
            yield place, str(_folder_copy(real, target) if path.is_dir() else real)


def _folder_copy(folder: Path, target: Path) -> Path:
    copy = target / _FOLDER / f"{len(list((target / _FOLDER).glob('*'))) + 1}-{folder.name}"
    shutil.copytree(folder, copy)
    return copy


def _references(fleet: Fleet) -> Iterator[tuple[Place, Path]]:
    """Every place with a path of a file that its fleet needs, and that path on this machine."""
    for name, profile in fleet.hardware.items():
        for key in ("image", "usign_key"):
            if written := getattr(profile.firmware, key):
                yield ("hardware", name, "firmware", key), located(profile.firmware.base, written)
        yield from _listed(fleet, ("hardware", name, "package_files"), profile.package_files)
    for name, mesh in fleet.meshes.items():
        if mesh.key is not None:
            yield from _secret(("meshes", name, "key"), mesh.key)
        parts, place = mesh.operator_parts, ("meshes", name, "operator_parts")
        if parts.templates:
            yield (*place, "templates"), located(parts.base, parts.templates)
        yield from _listed(fleet, (*place, "package_files"), parts.package_files)
    for key in ("keys", "relay_keys"):
        for number, ref in enumerate(getattr(fleet.udp_mesh, key)):
            yield from _secret(("udp_mesh", key, str(number)), ref)
    for key in ("credentials", "ca"):
        if fleet.nats is not None and (written := getattr(fleet.nats, key)):
            yield ("nats", key), file_path(fleet, written)


def _listed(fleet: Fleet, place: Place, files: tuple[str, ...]) -> Iterator[tuple[Place, Path]]:
    return (((*place, str(number)), file_path(fleet, file)) for number, file in enumerate(files))


def _secret(place: Place, ref: SecretRef) -> Iterator[tuple[Place, Path]]:
    key = {SecretKind.FILE: "file", SecretKind.AGE: "age"}.get(ref.kind)
    for name, written in ((key, ref.where), ("identity", ref.identity)):
        if name is not None and written:
            yield (*place, name), located(ref.base, written)
