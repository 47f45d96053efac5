"""Files -> tree -> document -> node specs -> fleet; each stage reports all its diagnostics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from meshctl.diagnostics import Diagnostic, InvalidInput, Position, Severity, sorted_diagnostics
from meshctl.inventory.build import build
from meshctl.inventory.codes import UNKNOWN_MESH
from meshctl.inventory.include import read_files
from meshctl.inventory.layers import resolve_layers
from meshctl.inventory.nodes import without_entries_of
from meshctl.inventory.source import Reader, read_bytes
from meshctl.inventory.validate import validate
from meshctl.model import Fleet
from meshctl.suggest import did_you_mean

_NO_ENVIRON: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Loaded:
    """`fleet` is None exactly if `diagnostics` contains an error. `files` are all files read, in order."""

    fleet: Fleet | None
    diagnostics: tuple[Diagnostic, ...]
    files: tuple[str, ...]


def load(path: Path, *, environ: Mapping[str, str] = _NO_ENVIRON, read: Reader = read_bytes) -> Loaded:
    """Load the inventory at `path`: a YAML file, or a directory with `fleet.yaml`.

    `environ` provides `HOME` for `~` in includes; `read` returns a file's bytes and may raise OSError. Never raises for
    the content of a file.
    """
    merged = read_files(path, environ, read)
    files = tuple(str(file) for file in merged.files)
    problems = list(merged.diagnostics)
    fleet: Fleet | None = None
    if merged.root is not None:
        validated = validate(merged.root)
        problems.extend(validated.diagnostics)
        if validated.document is not None:
            resolved = resolve_layers(validated.document, merged.root)
            built = build(validated.document, merged.root, resolved.nodes, merged.files)
            problems.extend(resolved.diagnostics)
            problems.extend(without_entries_of(resolved.diagnostics, built.diagnostics))
            fleet = built.fleet
    return Loaded(None if problems else fleet, sorted_diagnostics(problems), files)


def load_fleet(path: Path, *, environ: Mapping[str, str] = _NO_ENVIRON) -> Fleet:
    """Load the fleet. Raises InvalidInput with all diagnostics if there are any, and for radios of unknown meshes: lint
    reports those beside all else (MC101), and no other command can go on."""
    loaded = load(path, environ=environ)
    if loaded.fleet is None:
        raise InvalidInput(loaded.diagnostics)
    if unknown := _unknown_meshes(loaded.fleet):
        raise InvalidInput(sorted_diagnostics(unknown))
    return loaded.fleet


def _unknown_meshes(fleet: Fleet) -> list[Diagnostic]:
    """One diagnostic for each place that names a mesh which is not there."""
    found: dict[Position, Diagnostic] = {}
    for node in fleet.nodes.values():
        for radio in node.radios:
            if radio.mesh is not None and radio.mesh not in fleet.meshes:
                path = ("nodes", node.name, "radios", radio.name, "mesh")
                where, message = fleet.where(*path).position, f"unknown mesh {radio.mesh!r}"
                hint = did_you_mean(radio.mesh, fleet.meshes) or f"its meshes are {', '.join(fleet.meshes) or 'none'}"
                known = Diagnostic(UNKNOWN_MESH, Severity.ERROR, where, message, ".".join(path), hint=hint)
                found.setdefault(where, known)
    return list(found.values())
