"""TOML with source lines: text -> tables that know the line of every key and collect all problems.

`parse` reads the text, `Table` returns checked values and tracks which keys were read, `Table.finish` reports the
others with the closest known name. `tomllib` provides no lines, so `locate` finds them by scanning the text for tables
and keys.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem of a configuration: where, what was expected, what was found, and perhaps a hint."""

    file: str
    line: int
    """0 for a problem of the whole file."""
    key: str
    expected: str
    found: str
    hint: str = ""

    def __str__(self) -> str:
        where = f"{self.key}: " if self.key else ""
        hint = f" ({self.hint})" if self.hint else ""
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {where}expected {self.expected}, found {self.found}{hint}"


class ConfigurationError(Exception):
    """An invalid configuration; `problems` lists everything that is wrong."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(map(str, self.problems)))


KeyPath = tuple[str | int, ...]


def locate(text: str) -> dict[KeyPath, int]:
    """Line of every table and of every key that starts a line; keys in an inline table have its line."""
    lines: dict[KeyPath, int] = {}
    table: KeyPath = ()
    counts: dict[KeyPath, int] = {}
    open_brackets, open_string = 0, ""
    for number, line in enumerate(text.split("\n"), start=1):
        if not open_brackets and not open_string:
            header = _HEADER.match(line)
            if header:
                keys = tuple(_split_key(header["key"]))
                if header["array"]:
                    lines.setdefault(keys, number)
                    counts[keys] = counts.get(keys, -1) + 1
                    table = (*keys, counts[keys])
                else:
                    table = _enter(keys, counts)
                lines.setdefault(table, number)
                continue
            assignment = _ASSIGNMENT.match(line)
            if assignment:
                keys = tuple(_split_key(assignment["key"]))
                for end in range(1, len(keys) + 1):
                    lines.setdefault(table + keys[:end], number)
                line = line[assignment.end() :]
        open_brackets, open_string = _scan_value(line, open_brackets, open_string)
    return lines


_KEY = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\]|\\.)*"|'[^']*')"""
_HEADER = re.compile(rf"\s*\[(?P<array>\[)?\s*(?P<key>{_KEY}(?:\s*\.\s*{_KEY})*)\s*\]")
_ASSIGNMENT = re.compile(rf"\s*(?P<key>{_KEY}(?:\s*\.\s*{_KEY})*)\s*=")


def _split_key(dotted: str) -> Iterator[str]:
    for part in re.findall(_KEY, dotted):
        yield part[1:-1] if part[0] in "\"'" else part


def _enter(keys: tuple[str, ...], counts: Mapping[KeyPath, int]) -> KeyPath:
    """The path of a plain table, inside the latest element if its parent is an array of tables."""
    path: KeyPath = ()
    for key in keys:
        path = (*path, key)
        if path != keys and path in counts:
            path = (*path, counts[path])
    return path


def _scan_value(line: str, brackets: int, string: str) -> tuple[int, str]:
    """Open brackets and the open multi-line string after this line, so that their content is not taken for keys."""
    place = 0
    while place < len(line):
        if string:
            end = line.find(string, place)
            if end < 0:
                return brackets, string if len(string) == 3 else ""
            place, string = end + len(string), ""
            continue
        character = line[place]
        if character == "#":
            break
        if character in "\"'":
            string = character * 3 if line.startswith(character * 3, place) else character
            place += len(string)
            continue
        brackets += (character in "[{") - (character in "]}")
        place += 1
    return max(brackets, 0), string if len(string) == 3 else ""


@dataclass(slots=True)
class Source:
    """One configuration file: its name for messages, the lines of its keys, the problems found so far."""

    file: str
    lines: dict[KeyPath, int]
    problems: list[Problem] = field(default_factory=list)
    places: dict[str, dict[str, None]] = field(default_factory=dict)
    """The tables that have a key of this name, in the order of reading."""
    unknown: dict[Problem, tuple[str, str]] = field(default_factory=dict)
    """The table and the key of each problem with a key that the table does not have."""

    def line(self, path: KeyPath) -> int:
        """The line of this key, or of the nearest enclosing table."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1)

    def report(self, path: KeyPath, expected: str, found: str, hint: str = "", not_in: str = "") -> None:
        """`not_in` is the title of the table if it does not have this key."""
        key = ".".join(str(part) for part in path)
        problem = Problem(self.file, self.line(path), key, expected, found, hint)
        if problem not in self.problems:
            self.problems.append(problem)
        if not_in:
            self.unknown[problem] = (not_in, str(path[-1]))

    def all_problems(self) -> list[Problem]:
        """By line. Once all tables are read, a key that another table has is said to belong there: in TOML, a key is
        part of the table whose header stands above it."""
        found = []
        for problem in self.problems:
            table, key = self.unknown.get(problem, ("", ""))
            places = [place for place in self.places.get(key, ()) if place != table]
            hint = f"it belongs {' or '.join(places)}" if places else problem.hint
            found.append(dataclasses.replace(problem, hint=hint))
        return sorted(found, key=lambda problem: problem.line)


def parse(text: str, file: str) -> Table:
    """The root table of a TOML text. Raises ConfigurationError on a syntax error."""
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError([_syntax_problem(text, file, str(error))]) from error
    except RecursionError as error:
        raise ConfigurationError([Problem(file, 0, "", "less deeply nested values", "hundreds of brackets")]) from error
    return Table(values, Source(file, locate(text)), ())


def _syntax_problem(text: str, file: str, error: str) -> Problem:
    """An error of `tomllib` as a problem. The text itself is not quoted: it may contain a key."""
    at = re.search(r"\(at line (?P<line>\d+), column (?P<column>\d+)\)$", error)
    line = int(at["line"]) if at else text.count("\n") + 1
    place = f"at column {at['column']}" if at else "at the end of the file"
    reason = re.sub(r" \(at .*\)$", "", error)
    match reason:
        case "Invalid value":
            expected = "a value (text in quotes, a number, true, false, [...] or {...})"
            return Problem(file, line, "", expected, "something else", place)
        case "Cannot overwrite a value":
            return Problem(file, line, "", "each key once", "a duplicate key", place)
        case _ if declared := re.fullmatch(r"Cannot declare \((?P<keys>.*)\) twice", reason):
            table = ".".join(re.findall(r"'((?:[^'\\]|\\.)*)'", declared["keys"]))
            return Problem(file, line, "", "each table once", f"a duplicate table [{table}]", place)
        case _ if reason.startswith("Expected "):
            return Problem(file, line, "", reason.removeprefix("Expected "), "something else", place)
        case _:
            return Problem(file, line, "", "TOML", f"{reason[:1].lower()}{reason[1:]}", place)


class Table:
    """One table; each getter checks the value of a key, reports problems and returns the default instead of raising."""

    def __init__(self, values: Mapping[str, object], source: Source, path: KeyPath) -> None:
        self._values = values
        self._known: set[str] = set()
        self.source = source
        self.path = path

    def has(self, key: str) -> bool:
        return key in self._values

    def _take(self, key: str) -> object:
        self._known.add(key)
        self.source.places.setdefault(key, {}).setdefault(self._title())
        return self._values.get(key)

    def report(self, key: str, expected: str, found: object, hint: str = "") -> None:
        self.source.report((*self.path, key), expected, show(found), hint)

    def text(self, key: str, default: str | None = None, expected: str = "a string") -> str | None:
        value = self._take(key)
        if isinstance(value, str) and "\0" in value:
            self.report(key, "a string without NUL characters", value.replace("\0", "\\u0000"))
            return default
        if value is None or isinstance(value, str):
            return default if value is None else value
        self.report(key, expected, value)
        return default

    def boolean(self, key: str, default: bool) -> bool:
        value = self._take(key)
        if value is None or isinstance(value, bool):
            return default if value is None else value
        self.report(key, "true or false", value)
        return default

    def integer(self, key: str, default: int | None, low: int, high: int) -> int | None:
        value = self._take(key)
        if value is None:
            return default
        if isinstance(value, int) and not isinstance(value, bool) and low <= value <= high:
            return value
        self.report(key, f"an integer from {low} to {high}", value)
        return default

    def number(self, key: str, default: float | None, low: float, high: float) -> float | None:
        value = self._take(key)
        if value is None:
            return default
        if isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high:
            return float(value)
        self.report(key, f"a number from {low:g} to {high:g}", value)
        return default

    def choice(
        self, key: str, default: str, choices: Iterable[str], earlier: Mapping[str, str] = MappingProxyType({})
    ) -> str:
        """`earlier`: spellings that are still accepted -> what they are now."""
        value, allowed = self._take(key), tuple(choices)
        if value is None:
            return default
        if isinstance(value, str) and earlier.get(value, value) in allowed:
            return earlier.get(value, value)
        self.report(key, " or ".join(f'"{name}"' for name in allowed), value, did_you_mean(value, allowed))
        return default

    def texts(self, key: str) -> tuple[str, ...]:
        value = self._take(key)
        if value is None:
            return ()
        if isinstance(value, list) and all(isinstance(item, str) for item in value):
            return tuple(value)
        self.report(key, "a list of strings", value)
        return ()

    def integer_or_word(self, key: str, word: str, low: int, high: int) -> int | None:
        """An integer, or None if the value is `word` or missing."""
        value = self._take(key)
        if value is None or value == word:
            return None
        if isinstance(value, int) and not isinstance(value, bool) and low <= value <= high:
            return value
        self.report(key, f'"{word}" or an integer from {low} to {high}', value)
        return None

    def table(self, key: str) -> Table:
        """The table of this key; empty if there is none."""
        value = self._take(key)
        if value is None:
            value = {}
        elif not isinstance(value, dict):
            self.source.report((*self.path, key), "a table", show(value), not_in=self._title())
            value = {}
        return Table(value, self.source, (*self.path, key))

    def tables(self, key: str) -> list[Table]:
        """The tables of an array of tables."""
        value = self._take(key)
        if value is None:
            return []
        if isinstance(value, list) and all(isinstance(item, dict) for item in value):
            return [Table(item, self.source, (*self.path, key, place)) for place, item in enumerate(value)]
        self.report(key, f"tables [[{'.'.join(str(part) for part in (*self.path, key))}]]", value)
        return []

    def named_tables(self) -> list[tuple[str, Table]]:
        """Every entry of this table, each of which must be a table."""
        return [(name, self.table(name)) for name in self._values]

    def finish(self) -> None:
        """Reports every key that was not read."""
        for key, value in self._values.items():
            if key not in self._known:
                hint = did_you_mean(key, self._known) or f"known keys: {', '.join(sorted(self._known))}"
                found = f"{key} = {show(value)}"
                self.source.report((*self.path, key), "a known key", found, hint, not_in=self._title())

    def _title(self) -> str:
        """This table as a hint names it. Each topic has a table of its own, so no single one is named."""
        match self.path:
            case ():
                return "above the first [table]"
            case ("topics", _):
                return "in the table of a topic"
            case (*keys, int()):
                return f"in [[{'.'.join(map(str, keys))}]]"
            case keys:
                return f"in [{'.'.join(map(str, keys))}]"


def did_you_mean(found: object, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(found), list(known), n=1, cutoff=0.6)
    return f"did you mean {near[0]!r}?" if near else ""


# Hexadecimal digits or base64, about as many as a key has: it may have lost or gained some. Paths consist of base64's
# characters, too, so only a whole text of that length counts.
_HEX_KEY = re.compile(r"[0-9A-Fa-f]{32}")
_BASE64_KEY = re.compile(r"[A-Za-z0-9+/_-]{40,48}={0,2}")


def may_be_key(text: str) -> bool:
    """Whether the text may contain a key, which must not reach a terminal or a log."""
    return _HEX_KEY.search(text) is not None or _BASE64_KEY.fullmatch(text.split("#")[0].strip()) is not None


def show(value: object) -> str:
    """A value as written in the file, truncated to one line. Text that may be a key is not shown."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return "a list of tables"
    if isinstance(value, list):
        return f"[{', '.join(map(show, value))}]" if len(str(value)) <= 60 else f"a list of {len(value)}"
    if isinstance(value, str) and may_be_key(value):
        return f"{len(value)} characters that may be a key (not shown)"
    if isinstance(value, str):
        return f'"{value}"' if len(value) <= 60 else f'"{value[:57]}..."'
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."
