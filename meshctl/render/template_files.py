"""The template files of a back end: which file on the device each makes, and where it may lie."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from meshctl.diagnostics import Diagnostic, InvalidInput, Position, Severity
from meshctl.file_access import HINT, Boundary
from meshctl.render.rendered import CONFIG_FOLDER
from meshctl.resources import shipped

# Codes of templates, described in docs/render.md.
TEMPLATE = "RND010"
NOT_UCI = "RND011"
NO_TEMPLATE = "RND012"

COMMON = "common"
SUFFIX = ".j2"


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


def refuse_outside(path: Path, boundary: Boundary) -> None:
    """Raises InvalidInput for a template folder or file outside the inventory's boundary."""
    if refusal := boundary.refusal(path):
        hint = HINT if refusal.startswith("outside") else ""
        raise InvalidInput(
            [Diagnostic(NO_TEMPLATE, Severity.ERROR, Position(str(path)), f"not allowed: {refusal}", hint=hint)]
        )


def template_files(layers: list[tuple[str, Path]], boundary: Boundary) -> tuple[TemplateFile, ...]:
    """One template per path on the device, from the first layer that has it. Raises InvalidInput."""
    found: dict[str, TemplateFile] = {}
    for prefix, folder in layers:
        for source in sorted(folder.rglob(f"*{SUFFIX}")):
            inside = source.relative_to(folder).as_posix()
            if not folder.is_relative_to(shipped("templates")):
                refuse_outside(source, boundary)
            if not source.name.startswith("_") and source.is_file():
                path = inside.removesuffix(SUFFIX)
                found.setdefault(path, TemplateFile(path, f"{prefix}/{inside}", source))
    if not found:
        # without this, every node without configuration would be up to date
        place = Position(str(shipped("templates")))
        hint = "its installation is incomplete: install meshctl again"
        raise InvalidInput([Diagnostic(NO_TEMPLATE, Severity.ERROR, place, "the templates are missing", hint=hint)])
    return tuple(found[path] for path in sorted(found))
