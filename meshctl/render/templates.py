"""Find and render templates: folders searched in order, undefined names are errors, a sandbox unless all are shipped.

A folder has `common/`, for all back ends, and one folder per back end (`batman-adv/`, `meshmerize/`). Below them, a
template has the path of its file on the device plus `.j2`. Templates that start with `_` are only included by others.
For each file, the operator's parts of a back end take precedence over the inventory's `templates/`, and these over the
shipped templates.

`template_set` renders; it is imported with Jinja when the first template is, because commands such as lint rarely need
it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from meshctl.diagnostics import Diagnostic, InvalidInput, Position, Severity
from meshctl.file_access import Boundary, located
from meshctl.model import Backend, Fleet, OperatorParts
from meshctl.render.sandbox import LimitExceeded, SandboxRenderer
from meshctl.render.template_files import COMMON, NO_TEMPLATE, TEMPLATE, TemplateFile, refuse_outside
from meshctl.resources import shipped

if TYPE_CHECKING:
    from meshctl.render.template_set import TemplateSet


class Templates:
    """The templates of one fleet, compiled once; share the object between nodes. All fleets share the shipped ones."""

    def __init__(self, folders: tuple[Path, ...], boundary: Boundary | None = None) -> None:
        self._folders = folders
        self._only_shipped_folders = folders == (shipped("templates"),)
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
        refuse_outside(own, boundary)
        _refuse_unknown_folders(own, fleet)
        return cls((own, shipped("templates")), boundary)

    def files(self, backend: Backend, parts: OperatorParts) -> tuple[TemplateFile, ...]:
        """The templates of a back end's files, sorted by path. Raises InvalidInput if parts are missing."""
        return self._set(backend, parts).files

    def text(self, file: TemplateFile, backend: Backend, parts: OperatorParts, context: Mapping[str, object]) -> str:
        """The template's text for one node. Raises InvalidInput naming the template and its line."""
        if self.are_shipped(parts):
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
                Diagnostic(
                    **{
                        **diagnostic,
                        "severity": Severity(diagnostic["severity"]),
                        "position": Position(**diagnostic["position"]),
                    }
                )
                for diagnostic in answer["diagnostics"]
            )
        return str(answer["text"])

    def are_shipped(self, parts: OperatorParts) -> bool:
        """Whether all templates are those shipped with meshctl, none the operator's."""
        return self._only_shipped_folders and not parts.templates

    def _set(self, backend: Backend, parts: OperatorParts) -> TemplateSet:
        from meshctl.render.template_set import TemplateSet, shipped_set

        if self.are_shipped(parts):
            return shipped_set(backend)
        key = (backend, parts)
        if key not in self._sets:
            self._sets[key] = TemplateSet(self._folders, backend, parts, self._boundary)
        return self._sets[key]


def _refuse_unknown_folders(own: Path, fleet: Fleet) -> None:
    known = {COMMON, *(backend.value for backend in Backend)}
    parts = [mesh.operator_parts for mesh in fleet.meshes.values()]
    elsewhere = {located(item.base, item.templates).resolve() for item in parts if item.templates}
    expected = ", ".join(sorted(known))
    strays = [
        Diagnostic(NO_TEMPLATE, Severity.ERROR, Position(str(folder)), "", "", f"one of {expected}", folder.name)
        for folder in sorted(own.iterdir())
        if folder.is_dir() and folder.name not in known and folder.resolve() not in elsewhere
    ]
    if strays:
        raise InvalidInput(strays)
