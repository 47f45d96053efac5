"""Settings applied to the text of a scenario (YAML): the value at each path is replaced, or a missing key added.

Working on the text leaves the check of every value, with its line, to the scenario's own reader.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import yaml

from mesh_sweep.cases import Settings
from mesh_sweep.errors import SweepError

_STEP = re.compile(r"([^.\[\]]+)|\[(\d{1,6})\]", re.ASCII)


@dataclass(frozen=True, slots=True)
class EditedText:
    """The text with the settings; `inserted_lines` are the numbers, from 1, of lines that are not in the original."""

    text: str
    inserted_lines: tuple[int, ...] = ()

    def original_line(self, line: int) -> int:
        """The line of the original at a line of the edited text; for an added key, that of the key after it."""
        return line - sum(inserted < line for inserted in self.inserted_lines)


def steps_of(path: str) -> list[str | int]:
    """`flows[0].size_bytes` as `["flows", 0, "size_bytes"]`; empty for what is no path."""
    steps: list[str | int] = []
    at = 0
    while at < len(path):
        if steps and path[at] == ".":
            at += 1
        match = _STEP.match(path, at)
        if match is None or (match[1] is not None and at and path[at - 1] != "."):
            return []
        steps.append(match[1] if match[1] is not None else int(match[2]))
        at = match.end()
    return steps if path and not path.endswith(".") and isinstance(steps[0], str) else []


def with_settings(text: str, settings: Settings, file: str, named: frozenset[str] = frozenset()) -> EditedText:
    """The text with a value at each path.

    `named` are the paths of mappings whose keys are names that the file chooses (robots, topics): a missing one is a
    mistake, while a missing key elsewhere has a default. Raises SweepError with file, line, expected and found.
    """
    edited = EditedText(text)
    node = compose(text) if settings else None
    for path, value in settings:
        edited = _with_setting(edited, node, path, value, file, named)
        try:
            node = compose(edited.text)
        except yaml.YAMLError as error:
            # `-` and `a: b` are values in a list, as which they were checked, and not here
            raise SweepError(f"--set {path}={value}: expected one YAML value, found {value!r}") from error
    return edited


def _with_setting(
    edited: EditedText, node: yaml.Node | None, path: str, value: str, file: str, named: frozenset[str]
) -> EditedText:
    """`node` is the tree of the edited text."""
    steps = steps_of(path)
    where = f"--set {path}={value}"
    if not steps:
        raise SweepError(f"{where}: expected a path such as air.range_m or flows[0].size_bytes, found {path!r}")
    _check_value(value, where)
    if not isinstance(node, yaml.MappingNode):
        raise SweepError(f"{file}:1: {where}: expected a mapping, found none")
    walked = ""
    for number, step in enumerate(steps):
        line = edited.original_line(node.start_mark.line + 1)
        below: yaml.Node | None
        match node:
            case yaml.MappingNode():
                below = next((item for key, item in node.value if key.value == step), None)
                if below is None and (walked in named or isinstance(step, int)):
                    names = [str(key.value) for key, _ in node.value]
                    found = _unknown(str(step), names)
                    raise SweepError(f"{file}:{line}: {where}: {walked}: expected one of {', '.join(names)}{found}")
            case yaml.SequenceNode():
                if not isinstance(step, int) or step >= len(node.value):
                    places = f"{walked}[0] to {walked}[{len(node.value) - 1}]" if node.value else "an empty list"
                    raise SweepError(f"{file}:{line}: {where}: expected {places}, found {step!r}")
                below = node.value[step]
            case _:
                raise SweepError(
                    f"{file}:{line}: {where}: {walked}: expected a mapping or a list, found {node.value!r}"
                )
        if below is None:
            rest = value
            for name in reversed(steps[number + 1 :]):
                if isinstance(name, int):
                    raise SweepError(f"{file}:{line}: {where}: expected a list at {step}, found no such key")
                rest = f"{{{name}: {rest}}}"
            assert isinstance(node, yaml.MappingNode)
            return _inserted(edited, node, f"{step}: {rest}")
        walked = f"{walked}[{step}]" if isinstance(step, int) else f"{walked}.{step}" if walked else step
        node = below
    return _replaced(edited, node, value)


def _unknown(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"{f' (did you mean {near[0]!r}?)' if near else ''}, found {name!r}"


def _check_value(value: str, where: str) -> None:
    """One value in one line: it must not add keys, aliases or lines of its own."""
    # nested, so that a closing bracket or a comment cannot end what it stands in
    try:
        events = list(yaml.parse(f"[{value}]", Loader=yaml.SafeLoader))
        node = yaml.compose(f"[{value}]", Loader=yaml.SafeLoader)
    except yaml.YAMLError:
        node, events = None, []
    alone = isinstance(node, yaml.SequenceNode) and len(node.value) == 1 and not value.strip().startswith("&")
    if not alone or "\n" in value or any(isinstance(event, yaml.AliasEvent) for event in events):
        raise SweepError(f"{where}: expected one YAML value, found {value!r}")


def _replaced(edited: EditedText, node: yaml.Node, value: str) -> EditedText:
    start, end = node.start_mark.index, node.end_mark.index
    old = edited.text[start:end]
    if isinstance(node, yaml.CollectionNode) and not node.flow_style:
        # a block ends where the next token begins; its lines remain, so that no other line gets another number
        kept = "\n" * old.count("\n") + old[old.rfind("\n") + 1 :] if "\n" in old else ""
        return EditedText(f"{edited.text[:start]}{value}{kept}{edited.text[end:]}", edited.inserted_lines)
    space = " " if start and edited.text[start - 1] in ":-," else ""
    return EditedText(
        f"{edited.text[:start]}{space}{value}{chr(10) * old.count(chr(10))}{edited.text[end:]}", edited.inserted_lines
    )


def _inserted(edited: EditedText, node: yaml.MappingNode, entry: str) -> EditedText:
    start, text = node.start_mark.index, edited.text
    if node.flow_style:
        comma = ", " if node.value else ""
        return EditedText(f"{text[: start + 1]}{entry}{comma}{text[start + 1 :]}", edited.inserted_lines)
    line, indent = node.start_mark.line + 1, node.start_mark.column
    moved = (*(inserted_line + (inserted_line >= line) for inserted_line in edited.inserted_lines), line)
    return EditedText(f"{text[:start]}{entry}\n{' ' * indent}{text[start:]}", tuple(sorted(moved)))


def compose(text: str) -> yaml.Node | None:
    """The tree of a text that its reader accepted."""
    node: yaml.Node | None = yaml.compose(text, Loader=yaml.SafeLoader)
    return node


def fingerprint(texts: Iterable[str], without: frozenset[str] = frozenset({"seed"})) -> str:
    """The hash of what the texts say: 16 hex digits. Comments and layout do not count, nor do the top-level keys in
    `without`; the order of keys does, because seeds are drawn in it."""
    trees = [_value(compose(text), without) for text in texts]
    return hashlib.sha256(json.dumps(trees, separators=(",", ":")).encode()).hexdigest()[:16]


def _value(node: yaml.Node | None, without: frozenset[str] = frozenset()) -> Any:
    match node:
        case yaml.MappingNode():
            return {"map": [[key.value, _value(item)] for key, item in node.value if key.value not in without]}
        case yaml.SequenceNode():
            return [_value(item) for item in node.value]
        case None:
            return None
    return node.value
