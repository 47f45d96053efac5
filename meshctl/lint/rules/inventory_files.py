"""Files of the inventory (MC007)."""

from __future__ import annotations

import os.path
import re
from collections.abc import Iterator
from pathlib import Path

from meshctl.diagnostics import Severity
from meshctl.inventory.documents.root import InventoryDocument
from meshctl.lint.context import LintContext
from meshctl.lint.places import first_written
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Fleet

_SUFFIXES = (".yaml", ".yml")
_KEYS = frozenset(InventoryDocument.model_fields)
# a file with nothing else may belong to another program
_SECTIONS = frozenset({"hardware", "meshes", "groups", "nodes", "sites", "robots", "topics"})
_KEY = re.compile(r"^(?P<key>[^\s#'\"{}\[\],&*!|>%@`-][^\s:]*):(?:\s|$)", re.MULTILINE)
_NORTH = {"north.yaml": "topics: {news: {priority: 6, rate_hz: 0.1, size_bytes: 200}}\n"}


@fleet_rule(
    "MC007",
    Severity.WARNING,
    "A file beside the inventory is not included",
    why="""Its nodes, robots or topics are not part of the fleet: no command knows them, and lint does not check
    them.""",
    fix="List the file under `include`, or move it to another folder.",
    failing=Example("fleet: mine", files=_NORTH),
    passing=Example("include: [north.yaml]", files=_NORTH),
)
def file_not_included(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    read = {os.path.normpath(file) for file in fleet.files}
    for folder in sorted({Path(file).parent for file in read}):
        files = [path for path in context.files.inside(folder) if path.suffix in _SUFFIXES]
        texts = {path: context.files.text(path) or "" for path in files if str(path) not in read}
        keys = {path: {found["key"] for found in _KEY.finditer(text)} for path, text in texts.items()}
        others = [text for path, text in texts.items() if "meshctl" in keys[path]]
        for path, found in keys.items():
            # a file with `meshctl` is the first one of another inventory, which may include this one
            is_part = found & _SECTIONS and found <= _KEYS and "meshctl" not in found
            if is_part and not any(path.name in text for text in others):
                place, message = first_written(fleet, ("include",), ("fleet",)), f"{path.name} is not in the inventory"
                yield Finding(place, message, f"include: [{path.name}]", "not listed")
