"""A YAML node of a scenario: typed access to its value, with every problem collected by file and line."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator

import yaml


class Entry:
    """One YAML node: typed access, with problems collected in `problems`."""

    def __init__(self, node: yaml.Node | None, file: str, what: str, problems: list[str]) -> None:
        self.node, self.file, self.what, self.problems = node, file, what, problems

    def problem(self, expected: str, found: object = None, *, kind: str = "") -> None:
        line = 1 if self.node is None else self.node.start_mark.line + 1
        shown = kind or (self._found() if found is None else repr(found))
        self.problems.append(f"{self.file}:{line}: {self.what or 'scenario'}: expected {expected}, found {shown}")

    def _found(self) -> str:
        match self.node:
            case None:
                return "nothing"
            case yaml.ScalarNode():
                return repr(self.node.value)
            case yaml.SequenceNode():
                return "a list"
        return "a mapping"

    def mapping(self, known: tuple[str, ...] | None) -> dict[str, Entry]:
        """The entries of a mapping; keys that are not in `known` (None: any key) are problems."""
        if self.node is None:
            return {}
        if not isinstance(self.node, yaml.MappingNode):
            # never the text: a file that is one value may be a key file
            self.problem("a mapping", kind="a single value" if isinstance(self.node, yaml.ScalarNode) else "a list")
            return {}
        entries: dict[str, Entry] = {}
        for key, value in self.node.value:
            name = str(key.value) if isinstance(key, yaml.ScalarNode) else ""
            entry = Entry(value, self.file, f"{self.what}.{name}" if self.what else name, self.problems)
            if known is not None and name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                meant = f" (did you mean '{near[0]}'?)" if near else ""
                Entry(key, self.file, self.what, self.problems).problem(f"one of {', '.join(known)}{meant}", name)
            elif name in entries:
                entry.problem("each key once", name)
            else:
                entries[name] = entry
        return entries

    def items(self) -> Iterator[Entry]:
        if self.node is None:
            return
        if not isinstance(self.node, yaml.SequenceNode):
            self.problem("a list")
            return
        for number, child in enumerate(self.node.value):
            yield Entry(child, self.file, f"{self.what}[{number}]", self.problems)

    def text(self, default: str = "", one_of: tuple[str, ...] | None = None) -> str:
        if self.node is None:
            return default
        if not isinstance(self.node, yaml.ScalarNode) or (one_of is not None and self.node.value not in one_of):
            self.problem("text" if one_of is None else f"one of {', '.join(one_of)}")
            return default
        return str(self.node.value)

    def number(self, default: float, minimum: float = 0.0, maximum: float = 1e9) -> float:
        if self.node is None:
            return default
        try:
            value = float(self.node.value) if isinstance(self.node, yaml.ScalarNode) else math.nan
        except ValueError:
            value = math.nan
        if not minimum <= value <= maximum:
            self.problem(f"a number of at {f'most {maximum:g}' if value > maximum else f'least {minimum:g}'}")
            return default
        return value

    def integer(self, default: int, minimum: int = 0, maximum: int = 1_000_000_000) -> int:
        value = self.number(default, minimum, maximum)
        if value != int(value):
            self.problem("an integer")
        return int(value)

    def flag(self) -> bool:
        return self.text("false", ("true", "false")) == "true"
