"""Values -> YAML text for edits: one line in flow style, or an indented block."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

from meshctl.inventory.tree import Plain

Value = str | int | float | bool | None | Sequence["Value"] | Mapping[str, "Value"]

_BARE = re.compile(r"[A-Za-z_/][A-Za-z0-9_./@+-]*")
_SPECIAL = frozenset({"true", "false", "yes", "no", "on", "off", "y", "n", "null"})
# Ranges are unquoted keys in block style: `b[01-06]:`.
_BARE_KEY = re.compile(r"[A-Za-z_/][A-Za-z0-9_./@+\[\],-]*")


def flow(value: Value) -> str:
    """The value on one line."""
    match value:
        case None:
            return "null"
        case bool():
            return "true" if value else "false"
        case int() | float():
            return repr(value)
        case str():
            return _text(value)
        case Mapping():
            return "{" + ", ".join(f"{_text(key)}: {flow(item)}" for key, item in value.items()) + "}"
        case _:
            return "[" + ", ".join(flow(item) for item in value) + "]"


def line(key: str, value: Value, indent: int) -> str:
    """`key: value` on one line, from column `indent` (from 0)."""
    return f"{' ' * indent}{_key(key)}: {flow(value)}"


def block(key: str, value: Value, indent: int, step: int, newline: str) -> str:
    """`key: value`; the entries of a mapping are below its key, indented by `step`."""
    if not isinstance(value, Mapping) or not value:
        return line(key, value, indent)
    lines = [line(name, item, indent + step) for name, item in value.items()]
    return newline.join((f"{' ' * indent}{_key(key)}:", *lines))


def parsed_data(value: Value) -> object:
    """The expected result of parsing the text; compare with `tree.plain_data`."""
    match value:
        case None:
            return None
        case bool() | int() | float():
            return Plain(flow(value))
        case str():
            return value
        case Mapping():
            return {key: parsed_data(item) for key, item in value.items()}
        case _:
            return [parsed_data(item) for item in value]


def is_bare(text: str) -> bool:
    """Whether text needs no quotes to stay text."""
    return _is_bare(text, _BARE)


def _key(key: str) -> str:
    return key if _is_bare(key, _BARE_KEY) else _text(key)


def _is_bare(text: str, pattern: re.Pattern[str]) -> bool:
    return pattern.fullmatch(text) is not None and text.lower() not in _SPECIAL


def _text(text: str) -> str:
    if _is_bare(text, _BARE):
        return text
    return json.dumps(text, ensure_ascii=False)
