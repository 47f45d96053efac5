"""Files that an inventory names outside its own folder, for a copy of that folder.

From the copy, `../packages/batctl.ipk` is another file. `bring_outside_files` copies included files, and folders of
templates, which are read only from the inventory's tree; it writes the paths of these copies, and absolute ones of all
other files. Paths are replaced where they are written, so anchors and aliases stay as they are.
"""

from __future__ import annotations

import os
import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

from meshctl.file_access import located
from meshctl.inventory.compose import compose
from meshctl.inventory.file_paths import file_path
from meshctl.inventory.include import include_path, read_files
from meshctl.inventory.source import Source
from meshctl.inventory.text_edit import replace_value
from meshctl.inventory.tree import MappingNode, Scalar, SequenceNode, descend
from meshctl.model import Fleet, SecretKind, SecretRef

# in the copy: what comes from outside the inventory's folder
_FOLDER = "from-outside"
_BOM = "\ufeff"

Place = tuple[str | int, ...]


def bring_outside_files(source: Path, folder: Path, target: Path, fleet: Fleet, environ: Mapping[str, str]) -> None:
    """Make `target`, a copy of `folder`, an inventory of its own: with all that the inventory `source` includes, and
    paths that lead to the same files. Paths of files that do not exist stay: they may be meant to be made beside it."""
    home = folder.resolve()
    merged = read_files(source, environ)
    files = list(dict.fromkeys(file.resolve() for file in merged.files))
    copies = {file: target / file.relative_to(home) for file in files if file.is_relative_to(home)}
    outside = [file for file in files if file not in copies]
    copies |= {file: target / _FOLDER / f"{number}-{file.name}" for number, file in enumerate(outside, 1)}
    # file -> what is replaced in it, by its place in the text
    edits: dict[Path, dict[int, tuple[Scalar, str]]] = defaultdict(dict)
    for file in files if outside else ():
        edits[file] |= {item.start: (item, text) for item, text in _includes(file, copies, environ)}
    for place, path in _references(fleet):
        tree = None if merged.root is None else descend(merged.root, place)
        if not isinstance(tree, Scalar) or not path.exists():
            continue
        named_in, real = Path(tree.file).resolve(), path.resolve()
        if named_in in outside or not real.is_relative_to(home):
            edits[named_in][tree.start] = tree, str(_folder_copy(real, target) if path.is_dir() else real)
    for file in edits:
        text = _text(file)
        for tree, path_there in sorted(edits[file].values(), key=lambda edit: -edit[0].start):
            text = replace_value(text, tree, path_there, None)
        copies[file].parent.mkdir(parents=True, exist_ok=True)
        copies[file].write_bytes(text.encode())


def _text(file: Path) -> str:
    return file.read_bytes().decode("utf-8").removeprefix(_BOM)


def _includes(file: Path, copies: Mapping[Path, Path], environ: Mapping[str, str]) -> Iterator[tuple[Scalar, str]]:
    """The entries of the file's `include`, with the copies' paths."""
    root = compose(Source(str(file), _text(file))).root
    includes = root.values.get("include") if isinstance(root, MappingNode) else None
    for item in includes.items if isinstance(includes, SequenceNode) else ():
        if not isinstance(item, Scalar) or (named := include_path(item.text, file, environ)) is None:
            continue
        if (copy := copies.get(named.resolve())) is not None:
            yield item, os.path.relpath(copy, copies[file].parent)


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
            yield from _secret(("udp_mesh", key, number), ref)
    for key in ("credentials", "ca"):
        if fleet.nats is not None and (written := getattr(fleet.nats, key)):
            yield ("nats", key), file_path(fleet, written)


def _listed(fleet: Fleet, place: Place, files: tuple[str, ...]) -> Iterator[tuple[Place, Path]]:
    return (((*place, number), file_path(fleet, file)) for number, file in enumerate(files))


def _secret(place: Place, ref: SecretRef) -> Iterator[tuple[Place, Path]]:
    key = {SecretKind.FILE: "file", SecretKind.AGE: "age"}.get(ref.kind)
    for name, written in ((key, ref.where), ("identity", ref.identity)):
        if name is not None and written:
            yield (*place, name), located(ref.base, written)
