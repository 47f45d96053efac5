"""Text -> tree, by the rules of libuci's parser (file.c); errors have line and column.

`parse` reads one file of /etc/config, `parse_export` what `uci export` prints. Both split the text into statements
(`_Reader.statements`), the statements into arguments (`argument`), and fold the statements into sections (`_Builder`).

Surprising rules: `p`, `c`, `o` and `l` abbreviate the four keywords; an argument may contain quoted parts, which may
span lines; a backslash escapes except in single quotes; `#` starts a comment anywhere outside quotes; `;` separates
statements but, directly after an unquoted argument, silently ends the line; `option x ''` is ignored; a repeated named
section continues the first; `option` after `list` replaces it, and `list` after `option` appends to it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

from meshctl.diagnostics import Diagnostic, InvalidInput, Position, Severity
from meshctl.uci.tree import NAME, TYPE, Package, Section, Value

# isspace() of the C locale; other Unicode spaces are ordinary characters to libuci.
_SPACES = " \t\n\v\f\r"
_SPACE_RUN = re.compile(r"[ \t\n\v\f\r]*")
# A run of characters without special meaning.
_PLAIN_RUN = re.compile(r"[^'\"#;\\ \t\n\v\f\r]+")
# The name in a `package` line is more restricted than a file name.
_PACKAGE_LINE = re.compile(r"[A-Za-z0-9_-]+")
_KEYWORD = re.compile(r"[ \t]*([^ \t]*)[ \t]?")
_KEYWORDS = {word: word[0] for word in ("package", "config", "option", "list")} | {c: c for c in "pcol"}
# Fast path for the two most common forms of lines.
_COMMON_OPTION = re.compile(r"[ \t]*(option|list)[ \t]+([A-Za-z0-9_]+)[ \t]+'([^'\n]*)'[ \t]*(?:\n|\Z)")
_COMMON_CONFIG = re.compile(r"[ \t]*config[ \t]+([A-Za-z0-9_-]+)(?:[ \t]+'([A-Za-z0-9_]+)')?[ \t]*(?:\n|\Z)")


def parse(text: str, file: str, *, name: str = "") -> Package:
    """One configuration file; `package` lines in it are checked and ignored, as `uci_load` does.

    `name` is the package's name, by default the last part of `file`. Raises InvalidInput (UCI001) with line and column.
    """
    builder = _Builder(single=True)
    builder.open_package(name or file.rsplit("/", 1)[-1])
    _Reader(text, file).statements(builder)
    return builder.packages()[0]


def parse_export(text: str, file: str) -> tuple[Package, ...]:
    """The packages of `uci export`'s output, in order. Raises InvalidInput (UCI001) naming line and column."""
    builder = _Builder(single=False)
    _Reader(text, file).statements(builder)
    return builder.packages()


class _Refused(Exception):
    """An invalid statement; the reader adds the position."""

    def __init__(self, expected: str, found: str) -> None:
        super().__init__(expected, found)
        self.expected = expected
        self.found = found


@dataclass(slots=True)
class _OpenSection:
    type: str
    name: str | None
    # mutable, so that appending is cheap
    options: dict[str, str | list[str]] = field(default_factory=dict)

    def closed(self) -> Section:
        options: dict[str, Value] = {
            name: value if isinstance(value, str) else tuple(value) for name, value in self.options.items()
        }
        return Section(self.type, self.name, options)


@dataclass(slots=True)
class _OpenPackage:
    name: str
    sections: list[_OpenSection] = field(default_factory=list)
    named: dict[str, _OpenSection] = field(default_factory=dict)


class _Builder:
    """Folds statements into packages; `single` ignores `package` statements."""

    def __init__(self, *, single: bool) -> None:
        self._single = single
        self._packages: list[_OpenPackage] = []
        self._section: _OpenSection | None = None

    def packages(self) -> tuple[Package, ...]:
        return tuple(
            Package(package.name, tuple(section.closed() for section in package.sections)) for package in self._packages
        )

    def package(self, name: str) -> None:
        if not _PACKAGE_LINE.fullmatch(name):
            raise _Refused("a package name of letters, digits, _ and -", repr(name))
        if not self._single:
            self.open_package(name)

    def open_package(self, name: str) -> None:
        if any(package.name == name for package in self._packages):
            raise _Refused("each package once", f"{name!r} again")
        self._packages.append(_OpenPackage(name))
        self._section = None

    def config(self, type_name: str, name: str) -> None:
        if not self._packages:
            raise _Refused("a package line before the first section", "none")
        if not TYPE.fullmatch(type_name):
            raise _Refused("a section type in printable ASCII without spaces", repr(type_name))
        package = self._packages[-1]
        if not name:
            self._section = _OpenSection(type_name, None)
            package.sections.append(self._section)
            return
        earlier = package.named.get(name)
        if earlier is None:
            earlier = package.named[name] = _OpenSection(type_name, name)
            package.sections.append(earlier)
        elif earlier.type != type_name:
            raise _Refused(f"section {name!r} to be of type {earlier.type!r} as before", repr(type_name))
        self._section = earlier

    def option(self, name: str, value: str) -> None:
        section = self._require_section()
        if value:
            section.options[name] = value

    def list_item(self, name: str, value: str) -> None:
        section = self._require_section()
        before = section.options.setdefault(name, [])
        if isinstance(before, str):
            section.options[name] = [before, value]
        else:
            before.append(value)

    def _require_section(self) -> _OpenSection:
        if self._section is None:
            raise _Refused("a config line before the first option", "none")
        return self._section


class _Reader:
    """Reads the text; `_end` is the end of libuci's current input: the line, or the last line of a quoted part."""

    def __init__(self, text: str, file: str) -> None:
        self._text = text
        self._file = file
        self._at = 0
        self._end = 0

    def statements(self, builder: _Builder) -> None:
        """Pass every statement to `builder`. Raises InvalidInput at the first one that libuci would reject."""
        nul = self._text.find("\0")
        if nul >= 0:
            raise self._invalid(nul, "text", "a NUL byte")
        while self._end < len(self._text):
            if self._common_line(builder):
                continue
            self._next_line()
            self._skip_spaces()
            while self._statement(builder):
                pass

    def _common_line(self, builder: _Builder) -> bool:
        start = self._end
        option = _COMMON_OPTION.match(self._text, start)
        if option is not None:
            keyword, name, value = option.groups()
            add = builder.option if keyword == "option" else builder.list_item
            self._apply(lambda: add(name, value), start)
            self._end = option.end()
            return True
        section = _COMMON_CONFIG.match(self._text, start)
        if section is not None:
            type_name, section_name = section.groups(default="")
            self._apply(lambda: builder.config(type_name, section_name), start)
            self._end = section.end()
            return True
        return False

    def _statement(self, builder: _Builder) -> bool:
        """One statement of the line; False at the line's end."""
        found = _KEYWORD.match(self._text, self._at, self._end)
        word = found[1] if found is not None else ""
        if found is None or not word or word.startswith("#"):
            return False
        start = found.start(1)
        keyword = _KEYWORDS.get(word)
        if keyword is None:
            raise self._invalid(start, "package, config, option or list", repr(word))
        if found.end() == found.end(1):
            raise self._invalid(found.end(1), f"an argument after {word}", "the end of the file")
        self._at = found.end()
        self._run(builder, keyword, start)
        return True

    def _run(self, builder: _Builder, keyword: str, start: int) -> None:
        match keyword:
            case "p":
                name = self._required("a package name")
                self._end_of_statement()
                self._apply(lambda: builder.package(name), start)
            case "c":
                type_name = self._required("a section type")
                name = self._name(required=False, what="a section name")
                self._end_of_statement()
                self._apply(lambda: builder.config(type_name, name), start)
            case _:
                name = self._name(required=True, what="an option name")
                value = self._argument()
                self._end_of_statement()
                add = builder.option if keyword == "o" else builder.list_item
                self._apply(lambda: add(name, value), start)

    def _required(self, what: str) -> str:
        self._skip_spaces()
        at = self._at
        value = self._argument()
        if not value:
            raise self._invalid(at, what, "nothing")
        return value

    def _name(self, *, required: bool, what: str) -> str:
        self._skip_spaces()
        at = self._at
        value = self._required(what) if required else self._argument()
        if value and not NAME.fullmatch(value):
            raise self._invalid(at, f"{what} of letters, digits and _", repr(value))
        return value

    def _end_of_statement(self) -> None:
        self._skip_spaces()
        at = self._at
        extra = self._argument()
        if extra:
            raise self._invalid(at, "the end of the statement", repr(extra))

    def _argument(self) -> str:
        """The next argument, empty at the end of the line or statement."""
        self._skip_spaces()
        if self._char() == ";":
            self._at += 1
            return ""
        start = self._at
        parts: list[str] = []
        while True:
            match self._char():
                case "'":
                    self._single_quoted(parts)
                case '"':
                    self._double_quoted(parts)
                case "" | "#":
                    self._at = self._end
                    break
                case ";":
                    # libuci overwrites the semicolon with the terminator of an unquoted argument, which ends the line
                    if len("".join(parts)) == self._at - start:
                        self._at = self._end
                    break
                case "\\":
                    if self._backslash():
                        parts.append(self._char())
                        self._at += 1
                case _:
                    self._plain(parts)
            if self._char() in _SPACES:
                # nothing to skip at the end of the line
                self._at += 1 if self._char() else 0
                break
        return "".join(parts)

    def _single_quoted(self, parts: list[str]) -> None:
        start = self._at
        self._at += 1
        while True:
            close = self._text.find("'", self._at, self._end)
            parts.append(self._text[self._at : close if close >= 0 else self._end])
            if close >= 0:
                self._at = close + 1
                return
            self._at = self._end
            if not self._next_line():
                raise self._invalid(start, "a closing ' for this one", "the end of the file")

    def _double_quoted(self, parts: list[str]) -> None:
        start = self._at
        self._at += 1
        while True:
            match self._char():
                case '"':
                    self._at += 1
                    return
                case "":
                    if not self._next_line():
                        raise self._invalid(start, 'a closing " for this one', "the end of the file")
                    continue
                case "\\":
                    if not self._backslash():
                        continue
            parts.append(self._char())
            self._at += 1

    def _backslash(self) -> bool:
        """Skip a backslash; False if it continues the line."""
        self._at += 1
        if self._text[self._at : self._end] in ("", "\n", "\r\n"):
            self._at = self._end
            self._next_line()
            return False
        return True

    def _plain(self, parts: list[str]) -> None:
        found = _PLAIN_RUN.match(self._text, self._at, self._end)
        assert found is not None, "the next character is plain"
        parts.append(found[0])
        self._at = found.end()

    def _char(self) -> str:
        return self._text[self._at] if self._at < self._end else ""

    def _skip_spaces(self) -> None:
        found = _SPACE_RUN.match(self._text, self._at, self._end)
        self._at = found.end() if found is not None else self._at

    def _next_line(self) -> bool:
        """Read the next line; False at the end of the text."""
        if self._end >= len(self._text):
            return False
        self._at = self._end
        newline = self._text.find("\n", self._end)
        self._end = newline + 1 if newline >= 0 else len(self._text)
        return True

    def _apply(self, fold: Callable[[], None], at: int) -> None:
        try:
            fold()
        except _Refused as refused:
            raise self._invalid(at, refused.expected, refused.found) from None

    def _invalid(self, at: int, expected: str, found: str) -> InvalidInput:
        line = self._text.count("\n", 0, at) + 1
        column = at - self._text.rfind("\n", 0, at)
        place = Position(self._file, line, column)
        return InvalidInput([Diagnostic("UCI001", Severity.ERROR, place, "", expected=expected, found=found)])
