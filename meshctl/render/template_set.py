"""The templates of one back end, compiled and rendered with Jinja."""

from __future__ import annotations

import functools
import os
import resource
import traceback
from collections.abc import Callable, Mapping
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
from jinja2.utils import missing

from meshctl.diagnostics import Diagnostic, InvalidInput, Position, Severity
from meshctl.file_access import Boundary, located
from meshctl.model import Backend, MeshMode, OperatorParts, Release
from meshctl.render.quoting import quoted, require_quoted, revealed
from meshctl.render.template_files import (
    COMMON,
    NO_TEMPLATE,
    SUFFIX,
    TEMPLATE,
    TemplateFile,
    refuse_outside,
    template_files,
)
from meshctl.resources import shipped
from meshctl.suggest import did_you_mean


class TemplateSet:
    """The templates of one back end with one operator's parts."""

    def __init__(self, folders: tuple[Path, ...], backend: Backend, parts: OperatorParts, boundary: Boundary) -> None:
        layers: list[tuple[str, Path]] = []
        loaders: list[BaseLoader] = []
        shipped_loaders: list[BaseLoader] = []
        if parts.templates:
            own = located(parts.base, parts.templates)
            if not own.is_dir():
                found = Diagnostic(
                    NO_TEMPLATE, Severity.ERROR, Position(str(own)), "", "", "a folder of templates", "none"
                )
                raise InvalidInput([found])
            refuse_outside(own, boundary)
            if next(own.rglob(f"*{SUFFIX}"), None) is None:
                expected = f"templates below it, such as etc/config/{backend.value}{SUFFIX}"
                raise InvalidInput(
                    [Diagnostic(NO_TEMPLATE, Severity.ERROR, Position(str(own)), "", "", expected, "none")]
                )
            layers.append((backend.value, own))
            loaders.append(PrefixLoader({backend.value: _BoundedLoader(own, boundary)}))
        for folder in folders:
            layers.extend((part, folder / part) for part in (backend.value, COMMON))
            if folder == shipped("templates"):
                shipped_loaders.append(FileSystemLoader(folder))
                loaders.append(shipped_loaders[-1])
            else:
                loaders.append(_BoundedLoader(folder, boundary))
        loader = ChoiceLoader(loaders)
        # shipped templates are meshctl's own code, and the sandbox checks every attribute that they read
        kind = Environment if loaders == shipped_loaders else ImmutableSandboxedEnvironment
        self._plain = _environment(kind, loader)
        self._uci = _environment(kind, loader, is_uci=True)
        self._compiled: dict[str, Template] = {}
        self.files = template_files(layers, boundary)

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


@functools.cache
def shipped_set(backend: Backend) -> TemplateSet:
    """The templates of a back end without any of the operator's: the same for every fleet, compiled once a process."""
    folder = shipped("templates")
    return TemplateSet((folder,), backend, OperatorParts(), Boundary((os.path.realpath(folder),)))


class _BoundedLoader(FileSystemLoader):
    """A loader of regular files inside the inventory's boundary."""

    def __init__(self, folder: Path, boundary: Boundary) -> None:
        super().__init__(folder)
        self._folder, self._boundary = folder, boundary

    def get_source(self, environment: Environment, template: str) -> tuple[str, str, Callable[[], bool]]:
        refuse_outside(self._folder / template, self._boundary)
        return super().get_source(environment, template)


class _Missing(StrictUndefined):
    """Names what the value has instead, since templates are written without the code at hand."""

    @property
    def _undefined_message(self) -> str:
        name, value = self._undefined_name, self._undefined_obj
        if self._undefined_hint or value is missing or isinstance(value, Mapping):
            return super()._undefined_message
        known = [known for known in dir(value) if not known.startswith("_")]
        instead = did_you_mean(str(name), known) or f"it has {', '.join(known)}"
        return f"{type(value).__name__} has no {name!r}; {instead}"


def _environment(kind: type[Environment], loader: BaseLoader, *, is_uci: bool = False) -> Environment:
    environment = kind(
        loader=loader,
        undefined=_Missing,
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
            lines = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.endswith(SUFFIX)]
            if lines:
                place = Position(lines[-1].filename, lines[-1].lineno or 0)
    return Diagnostic(TEMPLATE, Severity.ERROR, place, _message(error))


def _message(error: Exception) -> str:
    match error:
        case MemoryError():
            limit, _ = resource.getrlimit(resource.RLIMIT_AS)
            return f"the template exceeds {limit >> 20} MiB of memory"
        case RecursionError():
            return "the template includes itself, or is nested too deeply"
        case UnicodeDecodeError():
            return f"expected UTF-8 text, found byte 0x{error.object[error.start]:02x} at offset {error.start}"
        case TemplateError() | ValueError() | TypeError():
            return str(error)
    return f"{type(error).__name__}: {error}"
