"""The tree of a UCI package: package -> sections in order -> options, each a string or a list of strings.

Trees are frozen and compared by content. Comparison ignores the order of options, which OpenWrt ignores, but not the
order of sections, which is significant (firewall rules).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TypeAlias

# An option's value: text, or the items of a list.
Value: TypeAlias = str | tuple[str, ...]

# libuci's rules for names of sections and options, types and packages (util.c, uci_validate_str).
NAME = re.compile(r"[A-Za-z0-9_]+")
TYPE = re.compile(r"[!-~]+")
PACKAGE_NAME = re.compile(r"[!-~]+")


@dataclass(frozen=True, slots=True)
class Section:
    """`config TYPE 'NAME'` and its options; `name` None is an anonymous section.

    Raises ValueError for what a UCI file cannot contain: a name with other characters than letters, digits and `_`, an
    empty option (libuci ignores `option x ''`), an empty list, a NUL.
    """

    type: str
    name: str | None = None
    options: Mapping[str, Value] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not TYPE.fullmatch(self.type):
            raise ValueError(f"section type: expected printable ASCII without spaces, found {self.type!r}")
        if self.name is not None and not NAME.fullmatch(self.name):
            raise ValueError(f"section name: expected letters, digits and _, found {self.name!r}")
        for option, value in self.options.items():
            _check_option(option, value)
        object.__setattr__(self, "options", MappingProxyType(dict(self.options)))

    def get(self, option: str, default: str = "") -> str:
        """A single value; a list gives its items joined by spaces, as `uci get` prints it."""
        value = self.options.get(option, default)
        return value if isinstance(value, str) else " ".join(value)

    def items(self, option: str) -> tuple[str, ...]:
        """A list's items; a single value gives one item, a missing option none."""
        value = self.options.get(option, ())
        return (value,) if isinstance(value, str) else value

    def __hash__(self) -> int:
        return hash((self.type, self.name, frozenset(self.options.items())))


@dataclass(frozen=True, slots=True)
class Package:
    """One file of /etc/config: its name and its sections in order. Named sections are unique (ValueError)."""

    name: str
    sections: tuple[Section, ...] = ()

    def __post_init__(self) -> None:
        if not PACKAGE_NAME.fullmatch(self.name):
            raise ValueError(f"package name: expected printable ASCII without spaces, found {self.name!r}")
        names = [section.name for section in self.sections if section.name is not None]
        if len(names) != len(set(names)):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"package {self.name}: duplicate section {twice!r}")

    def section(self, name: str) -> Section | None:
        """The section of that name, or None."""
        return next((section for section in self.sections if section.name == name), None)

    def of_type(self, type_name: str) -> Iterator[Section]:
        """The sections of one type, in order."""
        return (section for section in self.sections if section.type == type_name)

    def keys(self) -> tuple[str, ...]:
        """How the `uci` command addresses each section: its name, or `@TYPE[INDEX]` when anonymous.

        The index counts all sections of the type, named ones too (list.c, uci_lookup_ext_section).
        """
        seen: dict[str, int] = {}
        keys = []
        for section in self.sections:
            index = seen.get(section.type, 0)
            seen[section.type] = index + 1
            keys.append(section.name if section.name is not None else f"@{section.type}[{index}]")
        return tuple(keys)


def _check_option(option: str, value: Value) -> None:
    if not NAME.fullmatch(option):
        raise ValueError(f"option name: expected letters, digits and _, found {option!r}")
    if not value:
        raise ValueError(f"option {option}: expected a value, found an empty one, which UCI cannot represent")
    if "\0" in (value if isinstance(value, str) else "".join(value)):
        raise ValueError(f"option {option}: expected text, found a NUL byte")
