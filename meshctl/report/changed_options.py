"""Summarize a file's diff by its settings: `radio0: channel 149 -> 157, txpower 27 -> 25`.

Parses the unified diff of a plan, in which secrets are masked; for other files than UCI, counts the changed lines.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from meshctl.plan import FileChange
from meshctl.render.rendered import MARKER_PATH
from meshctl.wording import counted

# above this, settings are only counted
MAX_SETTINGS = 8

_SECTION = re.compile(r"config\s+(\S+)(?:\s+'(.*)')?")
_OPTION = re.compile(r"(?:option|list)\s+(\S+)\s+'(.*)'")
# the node's record of its configuration, different on every node
_DIGEST = re.compile(r"[+-]config=[0-9a-f]{64}")


def changed_lines(change: FileChange) -> tuple[str, ...]:
    """The added and removed lines, without hunk headers and context."""
    body = change.diff.splitlines()
    return tuple(line for line in diff_lines(change) if line[:1] in "+-" and line[1:].strip()) or tuple(body[:1])


def diff_lines(change: FileChange) -> tuple[str, ...]:
    """The diff without its head; without a digest that has changed, and empty if nothing else has."""
    lines = change.diff.splitlines()[2:]
    if change.path != MARKER_PATH or change.kind != "changed":
        return tuple(lines)
    shown = tuple(line for line in lines if not _DIGEST.fullmatch(line))
    return shown if any(line[:1] in "+-" for line in shown) else ()


def settings(change: FileChange) -> tuple[str, ...]:
    """One text per changed setting, by section; empty for an added or removed file."""
    if change.kind != "changed":
        return ()
    body = change.diff.splitlines()
    if not body or not body[0].startswith("---"):
        return tuple(body[:1])
    if not diff_lines(change):
        return ("digest of its configuration",)
    found = tuple(_by_section(body[2:]))
    return found or (counted(len(changed_lines(change)), "line"),)


def _by_section(lines: Iterable[str]) -> Iterator[str]:
    section = ""
    old: dict[tuple[str, str], list[str]] = {}
    new: dict[tuple[str, str], list[str]] = {}
    whole: dict[str, str] = {}
    for line in lines:
        if line.startswith("@@"):
            # the section may start above the hunk
            section = ""
            continue
        sign, text = line[:1], line[1:].strip()
        if head := _SECTION.fullmatch(text):
            section = head[2] or head[1]
            if sign in "+-":
                whole[section] = "new section" if sign == "+" else "section removed"
        elif (option := _OPTION.fullmatch(text)) and sign in "+-":
            (old if sign == "-" else new).setdefault((section, option[1]), []).append(option[2])
    yield from (_named(section, what) for section, what in whole.items())
    for key in dict.fromkeys((*old, *new)):
        section, name = key
        # an option that only moved, because another order of options is rendered, has not changed
        if section not in whole and old.get(key) != new.get(key):
            yield _named(section, f"{name} {_change(old.get(key, []), new.get(key, []))}")


def _named(section: str, what: str) -> str:
    return f"{section}: {what}" if section else what


def _change(old: list[str], new: list[str]) -> str:
    was, becomes = " ".join(old), " ".join(new)
    if not new:
        return f"removed (was {was})"
    return f"{was} -> {becomes}" if old else f"set to {becomes}"


def summary(change: FileChange) -> str:
    """The settings as one line; empty for an added or removed file."""
    found = settings(change)
    if len(found) > MAX_SETTINGS:
        return counted(len(found), "setting")
    parts: dict[str, list[str]] = {}
    for text in found:
        section, colon, rest = text.partition(": ")
        parts.setdefault(section if colon else "", []).append(rest if colon else text)
    return "; ".join((f"{section}: " if section else "") + ", ".join(texts) for section, texts in parts.items())
