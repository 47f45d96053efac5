"""Find and render templates: folders searched in order, one sandbox, undefined names are errors.

A folder has `common/`, for all back ends, and one folder per back end (`batman-adv/`, `meshmerize/`). Below them, a
template has the path of its file on the device plus `.j2`. Templates that start with `_` are only included by others.
For each file, the operator's parts of a back end take precedence over the inventory's `templates/`, and these over the
shipped templates.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from jinja2 import (
    BaseLoader,
    ChoiceLoader,
    Environment,
    FileSystemLoader,
    PrefixLoader,
    StrictUndefined,
    Template,
    TemplateError,
    TemplateNotFound,
    TemplateSyntaxError,
)
from jinja2.sandbox import ImmutableSandboxedEnvironment

from meshctl.diagnostics import Diagnostic, InvalidInput, Position, Severity
from meshctl.inventory.file_access import HINT, Boundary
from meshctl.model import Backend, Fleet, MeshMode, OperatorParts, Release
from meshctl.render.quoting import quoted, require_quoted, revealed
from meshctl.render.rendered import CONFIG_FOLDER
from meshctl.render.sandbox import LimitExceeded, SandboxRenderer
from meshctl.resources import shipped

# Codes of this module, described in docs/render.md.
TEMPLATE = "RND010"
NOT_UCI = "RND011"
NO_TEMPLATE = "RND012"

COMMON = "common"
_SUFFIX = ".j2"


@dataclass(frozen=True, slots=True)
class TemplateFile:
    """A template of a file: `path` on the device, `name` for the loader, `source` on disk."""

    path: str
    name: str
    source: Path

    @property
    def is_uci(self) -> bool:
        return self.path.startswith(CONFIG_FOLDER)

    @property
    def is_executable(self) -> bool:
        """Whether the template file is executable; then the rendered file is, too."""
        return bool(self.source.stat().st_mode & 0o100)


class Templates:
    """The templates of one fleet, compiled once; share the object between nodes."""

    def __init__(self, folders: tuple[Path, ...], boundary: Boundary | None = None) -> None:
        self._folders = folders
        self._boundary = boundary or Boundary(tuple(os.path.realpath(folder) for folder in folders))
        self._sets: dict[tuple[Backend, OperatorParts], TemplateSet] = {}
        # for templates that are not shipped
        self._bounded = SandboxRenderer()

    @classmethod
    def of(cls, fleet: Fleet) -> Templates:
        """The inventory's `templates` folder, if there is one, before the shipped templates.

        Raises InvalidInput for a folder in it that is not named after a back end: its templates would be ignored.
        """
        boundary = Boundary.of(Path(fleet.base), os.environ)
        own = Path(fleet.base) / "templates"
        if not fleet.base or not own.is_dir():
            return cls((shipped("templates"),), boundary)
        _refuse_outside(own, boundary)
        _refuse_unknown_folders(own, fleet)
        return cls((own, shipped("templates")), boundary)

    def files(self, backend: Backend, parts: OperatorParts) -> tuple[TemplateFile, ...]:
        """The templates of a back end's files, sorted by path. Raises InvalidInput if parts are missing."""
        return self._set(backend, parts).files

    def text(self, file: TemplateFile, backend: Backend, parts: OperatorParts, context: Mapping[str, object]) -> str:
        """The template's text for one node. Raises InvalidInput naming the template and its line."""
        if self._folders == (shipped("templates"),) and not parts.templates:
            return self._set(backend, parts).text(file, context)
        try:
            answer = self._bounded.text(self._folders, backend, parts, self._boundary, file, context)
        except LimitExceeded as reason:
            answer = {"exceeded": str(reason)}
        if "exceeded" in answer:
            place = Position(str(file.source))
            raise InvalidInput([Diagnostic(TEMPLATE, Severity.ERROR, place, str(answer["exceeded"]))])
        if "diagnostics" in answer:
            raise InvalidInput(
                Diagnostic(**{**one, "severity": Severity(one["severity"]), "position": Position(**one["position"])})
                for one in answer["diagnostics"]
            )
        return str(answer["text"])

    def _set(self, backend: Backend, parts: OperatorParts) -> TemplateSet:
        key = (backend, parts)
        if key not in self._sets:
            self._sets[key] = TemplateSet(self._folders, backend, parts, self._boundary)
        return self._sets[key]


def _refuse_outside(path: Path, boundary: Boundary) -> None:
    """Raises InvalidInput for a template folder or file outside the inventory's boundary."""
    if refusal := boundary.refusal(path):
        hint = HINT if refusal.startswith("outside") else ""
        raise InvalidInput(
            [Diagnostic(NO_TEMPLATE, Severity.ERROR, Position(str(path)), f"not allowed: {refusal}", hint=hint)]
        )


class _BoundedLoader(FileSystemLoader):
    """A loader of regular files inside the inventory's boundary."""

    def __init__(self, folder: Path, boundary: Boundary) -> None:
        super().__init__(folder)
        self._folder, self._boundary = folder, boundary

    def get_source(self, environment: Environment, template: str) -> tuple[str, str, Callable[[], bool]]:
        _refuse_outside(self._folder / template, self._boundary)
        return super().get_source(environment, template)


def _refuse_unknown_folders(own: Path, fleet: Fleet) -> None:
    known = {COMMON, *(backend.value for backend in Backend)}
    parts = [mesh.operator_parts for mesh in fleet.meshes.values()]
    elsewhere = {(Path(item.base) / item.templates).resolve() for item in parts if item.templates}
    expected = ", ".join(sorted(known))
    strays = [
        Diagnostic(NO_TEMPLATE, Severity.ERROR, Position(str(folder)), "", "", f"one of {expected}", folder.name)
        for folder in sorted(own.iterdir())
        if folder.is_dir() and folder.name not in known and folder.resolve() not in elsewhere
    ]
    if strays:
        raise InvalidInput(strays)


class TemplateSet:
    """The templates of one back end with one operator's parts."""

    def __init__(self, folders: tuple[Path, ...], backend: Backend, parts: OperatorParts, boundary: Boundary) -> None:
        layers: list[tuple[str, Path]] = []
        loaders: list[BaseLoader] = []
        if parts.templates:
            own = Path(parts.base) / parts.templates
            if not own.is_dir():
                found = Diagnostic(
                    NO_TEMPLATE, Severity.ERROR, Position(str(own)), "", "", "a folder of templates", "none"
                )
                raise InvalidInput([found])
            _refuse_outside(own, boundary)
            layers.append((backend.value, own))
            loaders.append(PrefixLoader({backend.value: _BoundedLoader(own, boundary)}))
        for folder in folders:
            layers.extend((part, folder / part) for part in (backend.value, COMMON))
            is_shipped = folder == shipped("templates")
            loaders.append(FileSystemLoader(folder) if is_shipped else _BoundedLoader(folder, boundary))
        loader = ChoiceLoader(loaders)
        self._plain = _environment(loader)
        self._uci = _environment(loader, is_uci=True)
        self._compiled: dict[str, Template] = {}
        self.files = _files(layers, boundary)

    def text(self, file: TemplateFile, context: Mapping[str, object]) -> str:
        try:
            if file.name not in self._compiled:
                self._compiled[file.name] = (self._uci if file.is_uci else self._plain).get_template(file.name)
            return self._compiled[file.name].render(context)
        except InvalidInput:
            raise
        except Exception as error:
            # a template can raise any exception; report all of them with the position
            raise InvalidInput([_diagnostic(file, error)]) from error


def _files(layers: list[tuple[str, Path]], boundary: Boundary) -> tuple[TemplateFile, ...]:
    """One template per path on the device, from the first layer that has it. Raises InvalidInput."""
    found: dict[str, TemplateFile] = {}
    for prefix, folder in layers:
        for source in sorted(folder.rglob(f"*{_SUFFIX}")):
            inside = source.relative_to(folder).as_posix()
            if not folder.is_relative_to(shipped("templates")):
                _refuse_outside(source, boundary)
            if not source.name.startswith("_") and source.is_file():
                path = inside.removesuffix(_SUFFIX)
                found.setdefault(path, TemplateFile(path, f"{prefix}/{inside}", source))
    return tuple(found[path] for path in sorted(found))


def _environment(loader: BaseLoader, *, is_uci: bool = False) -> ImmutableSandboxedEnvironment:
    environment = ImmutableSandboxedEnvironment(
        loader=loader,
        undefined=StrictUndefined,
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        auto_reload=False,
        finalize=require_quoted if is_uci else None,
    )
    environment.filters["uci"] = quoted
    environment.filters["reveal"] = revealed
    environment.globals["Release"] = Release
    environment.globals["MeshMode"] = MeshMode
    return environment


def _diagnostic(file: TemplateFile, error: Exception) -> Diagnostic:
    """The error, at the innermost template line of its traceback."""
    place = Position(str(file.source))
    match error:
        case TemplateSyntaxError():
            place = Position(error.filename or str(file.source), error.lineno)
        case TemplateNotFound():
            return Diagnostic(TEMPLATE, Severity.ERROR, place, "", expected="a template", found=f"none named {error}")
        case _:
            lines = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.endswith(_SUFFIX)]
            if lines:
                place = Position(lines[-1].filename, lines[-1].lineno or 0)
    kind = "" if isinstance(error, TemplateError | ValueError | TypeError) else f"{type(error).__name__}: "
    return Diagnostic(TEMPLATE, Severity.ERROR, place, f"{kind}{error}")
