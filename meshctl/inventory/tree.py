"""YAML values with positions: scalars keep their text, and the field that reads one decides its type.

So `country: NO` is Norway, `release: 24.10` keeps its zero, and `mac: 12:34:56:12:34:56` is not a base-60 number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from meshctl.diagnostics import Position

_NULLS = frozenset({"", "~", "null", "Null", "NULL"})


class Plain(str):
    """An unquoted scalar, whose type is undecided; a plain `str` was quoted and is text."""

    __slots__ = ()


@dataclass(slots=True)
class Scalar:
    """`line` and `column` count from 1; `start` and `end` are offsets into the file's text, quotes included."""

    file: str
    line: int
    column: int
    start: int
    end: int
    text: str
    is_plain: bool

    @property
    def is_null(self) -> bool:
        return self.is_plain and self.text in _NULLS

    @property
    def weight(self) -> int:
        return 1


@dataclass(slots=True)
class SequenceNode:
    """`weight` is the number of values with aliases expanded. `end` is exact for flow style (`[a, b]`) only."""

    file: str
    line: int
    column: int
    start: int
    end: int
    is_flow: bool
    items: list[Tree] = field(default_factory=list)
    weight: int = 1


@dataclass(slots=True)
class MappingNode:
    """`keys` and `values` have the same keys in the same order. `end` is exact for flow style only.
    `is_partial`: a merge key was refused, whose keys are missing here."""

    file: str
    line: int
    column: int
    start: int
    end: int
    is_flow: bool
    keys: dict[str, Scalar] = field(default_factory=dict)
    values: dict[str, Tree] = field(default_factory=dict)
    weight: int = 1
    is_partial: bool = False


Tree = Scalar | SequenceNode | MappingNode


def position(tree: Tree) -> Position:
    return Position(tree.file, tree.line, tree.column)


def plain_data(tree: Tree) -> object:
    """Dictionaries, lists, `Plain`, `str` and None: the input of the document models."""
    match tree:
        case Scalar():
            if tree.is_null:
                return None
            return Plain(tree.text) if tree.is_plain else tree.text
        case SequenceNode():
            return [plain_data(item) for item in tree.items]
        case MappingNode():
            return {key: plain_data(value) for key, value in tree.values.items()}


def child(tree: Tree, part: str | int) -> Tree | None:
    """The value under a key or a list index (also as text), or None."""
    match tree:
        case MappingNode():
            return tree.values.get(str(part))
        case SequenceNode():
            index = int(part) if isinstance(part, int) or part.isdecimal() else -1
            return tree.items[index] if 0 <= index < len(tree.items) else None
        case Scalar():
            return None


def descend(tree: Tree, path: Sequence[str | int]) -> Tree | None:
    """The value at `path`, or None if there is none."""
    found: Tree | None = tree
    for part in path:
        if found is None:
            return None
        found = child(found, part)
    return found


def key_position(tree: MappingNode, key: str) -> Position:
    """The position of `key` in `tree`; the mapping's own position if there is no such key."""
    written = tree.keys.get(key)
    return position(tree if written is None else written)


def position_of(root: Tree, path: Sequence[str | int]) -> Position | None:
    """The position of `path`: of a scalar itself; of the key of a list, mapping or null."""
    tree, place = root, position(root)
    for part in path:
        below = child(tree, part)
        if below is None:
            return None
        by_key = isinstance(tree, MappingNode) and (not isinstance(below, Scalar) or below.is_null)
        place = key_position(tree, str(part)) if by_key and isinstance(tree, MappingNode) else position(below)
        tree = below
    return place


def describe(tree: Tree) -> str:
    """The kind of a value; never the value, which may be a secret."""
    match tree:
        case Scalar():
            return "nothing" if tree.is_null else "a single value"
        case SequenceNode():
            return "a list"
        case MappingNode():
            return "a mapping"
