"""A baseline of known findings, so that only new ones count.

`fingerprint` identifies a finding by its subject, not its line, so that edits elsewhere do not make it new.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePath

from meshctl.diagnostics import Diagnostic, Position
from meshctl.errors import InputError
from meshctl.lint.engine import diagnostic
from meshctl.lint.rule import Finding
from meshctl.lint.rules.housekeeping import STALE_BASELINE

_VERSION = 1
# a finding takes about 200 bytes
_MAX_BYTES = 16 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class BaselineComparison:
    """`new` findings count; `known` ones are in the baseline; `stale` ones report entries that no longer occur."""

    new: tuple[Diagnostic, ...]
    known: tuple[Diagnostic, ...]
    stale: tuple[Diagnostic, ...]


def fingerprint(item: Diagnostic) -> str:
    """32 hexadecimal digits, equal for the same fault at the same path of the inventory."""
    parts = (item.code, PurePath(item.position.file).name, item.path, item.expected, item.found)
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def dump(diagnostics: Iterable[Diagnostic]) -> str:
    """The text of a baseline file: sorted, one finding per line."""
    entries = [
        json.dumps({"fingerprint": fingerprint(item), "code": item.code, "about": item.path or item.position.file})
        for item in sorted(diagnostics, key=lambda item: (item.code, item.path, fingerprint(item)))
    ]
    body = ",\n".join(f"    {entry}" for entry in entries)
    return f'{{\n  "version": {_VERSION},\n  "findings": [\n{body}\n  ]\n}}\n'


def read(path: Path) -> tuple[tuple[str, str, str], ...]:
    """The baseline's findings as (fingerprint, code, about). Raises InputError naming the file."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(f"{path}: expected a baseline of at most {_MAX_BYTES} bytes")
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", hint="write one with --write-baseline") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected a baseline in JSON: {error}") from error
    match document:
        case {"version": int(version), "findings": list(entries)} if version == _VERSION:
            return tuple(_entry(path, number, entry) for number, entry in enumerate(entries, 1))
        case _:
            raise InputError(f"{path}: expected a baseline of version {_VERSION}, written with --write-baseline")


def _entry(path: Path, number: int, entry: object) -> tuple[str, str, str]:
    match entry:
        case {"fingerprint": str(mark), "code": str(code), "about": str(about)}:
            return mark, code, about
        case _:
            raise InputError(f"{path}: finding {number}: expected fingerprint, code and about")


def compare(
    diagnostics: Iterable[Diagnostic], entries: Iterable[tuple[str, str, str]], path: Path, ran: Iterable[str]
) -> BaselineComparison:
    """Split findings by the baseline of `path`; entries of rules that did not run are kept."""
    known_codes = set(ran)
    rows = list(entries)
    left = Counter(mark for mark, _, _ in rows)
    new: list[Diagnostic] = []
    known: list[Diagnostic] = []
    for item in diagnostics:
        mark = fingerprint(item)
        if left[mark] > 0:
            left[mark] -= 1
            known.append(item)
        else:
            new.append(item)
    stale = []
    for mark, code, about in rows:
        if left[mark] > 0 and code in known_codes:
            left[mark] -= 1
            finding = Finding((), f"{code} is no longer found", "", about)
            stale.append(diagnostic(STALE_BASELINE, finding, Position(str(path))))
    return BaselineComparison(tuple(new), tuple(known), tuple(stale))
