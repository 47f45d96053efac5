"""Diff of two trees of one package, section by section; `apply(diff(a, b), a) == b`.

Sections are paired by name and type, anonymous ones by content and then by order within their type. The longest
increasing subsequence of pairs stays in place; the other pairs are listed as moved.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import SequenceMatcher
from enum import Enum

from meshctl.model import MASK
from meshctl.uci.text import quote
from meshctl.uci.tree import Package, Section, Value

# Options with keys and passwords in OpenWrt's packages, whose values are never shown. dropbear's PasswordAuth is only
# on or off.
_SECRET_OPTION = re.compile(
    r"(?!(Root)?PasswordAuth$)"
    r"(key\d?|token|license(_key)?|r[01]_key|.*(passw(or)?d|passphrase|psk|preshared_key|secret|private_key|_pwd).*)",
    re.IGNORECASE,
)
# wireless `key '1'` is only the index of a WEP key
_KEY_INDEXES = ("1", "2", "3", "4")
# a line of `uci changes`: `wireless.mesh0.key='it'\''s'`, `network.wg0.addresses+='...'`; values may have several lines
_CHANGED_OPTION = re.compile(r"([\w@\[\]-]{1,64}\.[\w@\[\]-]{1,64}\.)([\w-]{1,64})(\+?=)((?:'[^']*'?|\\')+|[^\n;]*)")


def is_secret_option(name: str) -> bool:
    """Whether an option of this name contains a key or password."""
    return _SECRET_OPTION.fullmatch(name) is not None


def is_secret(name: str, value: Value) -> bool:
    """Whether an option with this value contains a key or password."""
    return is_secret_option(name) and value not in _KEY_INDEXES


def masked_changes(text: str) -> str:
    """The output of `uci changes` with secrets masked."""

    def masked(found: re.Match[str]) -> str:
        where, name, sign, value = found.groups()
        return f"{where}{name}{sign}{MASK if is_secret(name, value.strip(chr(39))) else value}"

    return _CHANGED_OPTION.sub(masked, text)


class ChangeKind(Enum):
    ADDED = "added"
    REMOVED = "removed"
    CHANGED = "changed"
    MOVED = "moved"


@dataclass(frozen=True, slots=True)
class OptionChange:
    """An option that is set, changed or removed; None on the side where it is absent."""

    name: str
    before: Value | None
    after: Value | None

    def line(self) -> str:
        """`channel: '6' -> '11'`, secrets masked."""
        return f"{self.name}: {self._shown(self.before)} -> {self._shown(self.after)}"

    def _shown(self, value: Value | None) -> str:
        if value is None:
            return "(none)"
        if is_secret_option(self.name):
            return MASK
        return quote(value) if isinstance(value, str) else "[" + " ".join(quote(item) for item in value) + "]"


@dataclass(frozen=True, slots=True)
class SectionChange:
    """One section. `key` is its `uci` address in the new package, or in the old one if it is removed; the indexes are
    its positions before and after. A moved section may also have changed."""

    kind: ChangeKind
    key: str
    before: Section | None
    after: Section | None
    before_index: int | None
    after_index: int | None

    @property
    def options(self) -> tuple[OptionChange, ...]:
        """The options that differ, removed ones first, then in the new section's order."""
        old = self.before.options if self.before is not None else {}
        new = self.after.options if self.after is not None else {}
        gone = [OptionChange(name, value, None) for name, value in old.items() if name not in new]
        here = [OptionChange(name, old.get(name), value) for name, value in new.items() if old.get(name) != value]
        return (*gone, *here)


@dataclass(frozen=True, slots=True)
class Diff:
    """The changes from one package to another; false if there are none."""

    package: str
    changes: tuple[SectionChange, ...]

    def __bool__(self) -> bool:
        return bool(self.changes)

    def lines(self) -> Iterator[str]:
        """Lines for display, secrets masked: `~ wireless.radio0.channel: '6' -> '11'`, `+ network.bat0 (interface)`."""
        for change in self.changes:
            place = f"{self.package}.{change.key}"
            match change.kind:
                case ChangeKind.ADDED:
                    yield f"+ {place} ({_type(change.after)})"
                case ChangeKind.REMOVED:
                    yield f"- {place} ({_type(change.before)})"
                    continue
                case ChangeKind.MOVED:
                    yield f"~ {place}: place {change.before_index} -> {change.after_index}"
                case ChangeKind.CHANGED:
                    pass
            mark = "+" if change.kind is ChangeKind.ADDED else "~"
            yield from (f"{mark} {place}.{option.line()}" for option in change.options)


def _type(section: Section | None) -> str:
    return section.type if section is not None else ""


def diff(before: Package, after: Package) -> Diff:
    """The changes from `before` to `after`. Raises ValueError for packages with different names."""
    if before.name != after.name:
        raise ValueError(f"expected two versions of package {before.name}, found {after.name}")
    pairs = _pairs(before, after)
    still = _longest_increasing([pairs[index] for index in sorted(pairs)])
    old_keys, new_keys = before.keys(), after.keys()
    changes = [
        SectionChange(ChangeKind.REMOVED, old_keys[index], section, None, index, None)
        for index, section in enumerate(before.sections)
        if index not in pairs
    ]
    partner = {new: old for old, new in pairs.items()}
    for index, section in enumerate(after.sections):
        old_index = partner.get(index)
        if old_index is None:
            changes.append(SectionChange(ChangeKind.ADDED, new_keys[index], None, section, None, index))
            continue
        old = before.sections[old_index]
        if index not in still:
            changes.append(SectionChange(ChangeKind.MOVED, new_keys[index], old, section, old_index, index))
        elif old != section:
            changes.append(SectionChange(ChangeKind.CHANGED, new_keys[index], old, section, old_index, index))
    return Diff(before.name, tuple(changes))


def _pairs(before: Package, after: Package) -> dict[int, int]:
    """Index in `before` -> index in `after` of the same section."""
    new_names = {(s.name, s.type): index for index, s in enumerate(after.sections) if s.name is not None}
    pairs = {}
    for index, section in enumerate(before.sections):
        partner = new_names.get((section.name, section.type)) if section.name is not None else None
        if partner is not None:
            pairs[index] = partner
    for type_name in dict.fromkeys(s.type for s in before.sections if s.name is None):
        pairs.update(_anonymous_pairs(before, after, type_name))
    return pairs


def _anonymous_pairs(before: Package, after: Package, type_name: str) -> Iterator[tuple[int, int]]:
    """Pair equal sections first, and the sections between them in order."""
    old = [index for index, s in enumerate(before.sections) if s.name is None and s.type == type_name]
    new = [index for index, s in enumerate(after.sections) if s.name is None and s.type == type_name]
    matcher = SequenceMatcher(
        None, [before.sections[index] for index in old], [after.sections[index] for index in new], autojunk=False
    )
    for _, old_start, old_end, new_start, new_end in matcher.get_opcodes():
        yield from zip(old[old_start:old_end], new[new_start:new_end], strict=False)


def _longest_increasing(indexes: list[int]) -> frozenset[int]:
    """The members of a longest increasing subsequence."""
    tails: list[int] = []
    before: dict[int, int | None] = {}
    for index in indexes:
        at = bisect_left(tails, index)
        before[index] = tails[at - 1] if at else None
        tails[at : at + 1] = [index]
    chain: set[int] = set()
    current = tails[-1] if tails else None
    while current is not None:
        chain.add(current)
        current = before[current]
    return frozenset(chain)


def apply(change: Diff, package: Package) -> Package:
    """Apply a change. Raises ValueError if `package` is not the one that the diff was made from."""
    if package.name != change.package:
        raise ValueError(f"expected package {change.package}, found {package.name}")
    rest: dict[int, Section] = dict(enumerate(package.sections))
    placed: dict[int, Section] = {}
    for item in change.changes:
        if item.before_index is not None and rest.get(item.before_index) != item.before:
            raise ValueError(f"{change.package}.{item.key} differs from the base of the diff")
        match item.kind:
            case ChangeKind.REMOVED:
                del rest[_index(item.before_index)]
            case ChangeKind.MOVED:
                del rest[_index(item.before_index)]
                placed[_index(item.after_index)] = _section(item.after)
            case ChangeKind.ADDED:
                placed[_index(item.after_index)] = _section(item.after)
            case ChangeKind.CHANGED:
                rest[_index(item.before_index)] = _section(item.after)
    remaining = iter(rest.values())
    total = len(rest) + len(placed)
    sections = (placed[index] if index in placed else next(remaining) for index in range(total))
    return Package(package.name, tuple(sections))


def _index(value: int | None) -> int:
    if value is None:
        raise ValueError("a change without a place")
    return value


def _section(value: Section | None) -> Section:
    if value is None:
        raise ValueError("a change without a section")
    return value
