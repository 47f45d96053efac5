"""Typed access to a lab file's YAML that collects every problem with file, line and column.

text -> tree (the inventory's reader) -> `YamlEntry` -> the values that `propagation_file` and `scenario_file` read ->
`YamlEntry.finish` raises InvalidInput with all problems at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from meshctl.diagnostics import Diagnostic, InvalidInput, Position
from meshctl.inventory import codes
from meshctl.inventory.compose import compose
from meshctl.inventory.source import Source, read_source
from meshctl.inventory.tree import MappingNode, Scalar, SequenceNode, Tree, describe, position
from meshctl.suggest import did_you_mean


class YamlEntry:
    """One entry of the file, or an absent one, for which every reader returns its default."""

    def __init__(self, tree: Tree | None, path: str, problems: list[Diagnostic]) -> None:
        self.tree = None if isinstance(tree, Scalar) and tree.is_null else tree
        self.path = path
        self._where = tree
        self._problems = problems

    @property
    def is_present(self) -> bool:
        return self.tree is not None

    @property
    def is_list(self) -> bool:
        return isinstance(self.tree, SequenceNode)

    def has(self, key: str) -> bool:
        return isinstance(self.tree, MappingNode) and key in self.tree.values

    def problem(self, expected: str, found: str = "") -> None:
        """Add the problem that this entry is not `expected`."""
        place = Position("") if self._where is None else position(self._where)
        self._add(codes.WRONG_VALUE, place, expected, found or self._found())

    def finish(self) -> None:
        """Raises InvalidInput when the file has problems."""
        if self._problems:
            raise InvalidInput(self._problems)

    def mapping(self, known: tuple[str, ...] | None = None, required: tuple[str, ...] = ()) -> dict[str, YamlEntry]:
        """The entries by key. A `known` key (None: any key is) that is missing gets an absent entry."""
        if not isinstance(self.tree, MappingNode):
            if self.is_present or required:
                # never the text: a file that is one value may be a key file
                self.problem("a mapping", describe(self.tree) if isinstance(self.tree, Scalar) else "")
            return {key: self._child(None, key) for key in known or ()}
        entries = {key: self._child(None, key) for key in known or ()}
        for key, value in self.tree.values.items():
            if known is not None and key not in known:
                hint = did_you_mean(key, known)
                meant = f" ({hint})" if hint else ""
                place = position(self.tree.keys[key])
                self._add(codes.UNKNOWN_KEY, place, f"one of {', '.join(known)}{meant}", repr(key))
            else:
                entries[key] = self._child(value, key)
        for key in required:
            if key not in self.tree.values:
                self._add(codes.MISSING_KEY, position(self.tree), f"the key {key}", "no such key")
        return entries

    def items(self) -> Iterator[YamlEntry]:
        """The entries of a list."""
        if isinstance(self.tree, SequenceNode):
            for number, item in enumerate(self.tree.items):
                yield YamlEntry(item, f"{self.path}[{number}]", self._problems)
        elif self.is_present:
            self.problem("a list")

    def text(self, default: str = "", one_of: tuple[str, ...] | None = None) -> str:
        if self.tree is None:
            return default
        if isinstance(self.tree, Scalar) and (one_of is None or self.tree.text in one_of):
            return self.tree.text
        self.problem("text" if one_of is None else f"one of {', '.join(one_of)}")
        return default

    def number(self, default: float, minimum: float = -1e6, maximum: float = 1e6) -> float:
        if self.tree is None:
            return default
        try:
            value = float(self.tree.text) if isinstance(self.tree, Scalar) else math.nan
        except ValueError:
            value = math.nan
        if not minimum <= value <= maximum:
            self.problem(f"a number from {minimum:g} to {maximum:g}")
            return default
        return value

    def integer(self, default: int, minimum: int, maximum: int) -> int:
        value = self.number(float(default), minimum, maximum)
        if value != int(value):
            self.problem(f"an integer from {minimum} to {maximum}")
            return default
        return int(value)

    def flag(self, default: bool) -> bool:
        return self.text(str(default).lower(), ("true", "false")) == "true"

    def share(self, default: float) -> float:
        """`0.3` or `30%`."""
        if self.tree is None:
            return default
        value = share_of(self.tree.text) if isinstance(self.tree, Scalar) else None
        if value is None:
            self.problem("a share from 0 to 1, or 0% to 100%")
            return default
        return value

    def point(self, default: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
        """`[x, y]` in meters."""
        values = self.row(2, "[x, y] in meters")
        return (values[0], values[1]) if values else default

    def row(self, count: int, shape: str) -> list[float]:
        """A list of `count` numbers; for anything else an empty list and a problem."""
        if not isinstance(self.tree, SequenceNode) or len(self.tree.items) != count:
            self.problem(shape)
            return []
        before = len(self._problems)
        values = [item.number(0.0) for item in self.items()]
        return values if len(self._problems) == before else []

    def _child(self, tree: Tree | None, key: str) -> YamlEntry:
        entry = YamlEntry(tree, f"{self.path}.{key}" if self.path else key, self._problems)
        entry._where = tree or self._where
        return entry

    def _found(self) -> str:
        match self.tree:
            case None:
                return "nothing"
            case Scalar(text=text):
                return repr(text[:60])
            case SequenceNode(items=items):
                return f"a list of {len(items)}"
            case tree:
                return describe(tree)

    def _add(self, code: str, place: Position, expected: str, found: str) -> None:
        self._problems.append(codes.error(code, place, "", path=self.path, expected=expected, found=found))


def share_of(text: str) -> float | None:
    """`0.3` or `30%` as 0.3; None when it is not a share from 0 to 1."""
    number, scale = (text[:-1], 100.0) if text.endswith("%") else (text, 1.0)
    try:
        value = float(number) / scale
    except ValueError:
        return None
    return value if 0.0 <= value <= 1.0 else None


def read(path: Path) -> YamlEntry:
    """The root entry of the file. Raises InvalidInput when it cannot be read or is not YAML."""
    source = read_source(path)
    if isinstance(source, Diagnostic):
        raise InvalidInput([source])
    return parse_text(source.text, str(path))


def parse_text(text: str, file: str) -> YamlEntry:
    """The root entry of a file's text. Raises InvalidInput when it is not YAML."""
    composed = compose(Source(file, text))
    if composed.root is None:
        raise InvalidInput(composed.diagnostics)
    return YamlEntry(composed.root, "", list(composed.diagnostics))
