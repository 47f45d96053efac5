"""Diagnostic codes of the loader and their meanings; lint rules have separate codes (`MC...`)."""

from __future__ import annotations

from meshctl.diagnostics import Diagnostic, Position, Severity

UNREADABLE = "INV001"
TOO_LARGE = "INV002"
NOT_TEXT = "INV003"
YAML_SYNTAX = "INV004"
YAML_FEATURE = "INV005"
DUPLICATE_KEY = "INV006"
TOO_MANY_VALUES = "INV007"
TOO_DEEP = "INV008"
EMPTY = "INV009"
INCLUDE = "INV010"
INCLUDE_CLASH = "INV011"
UNKNOWN_KEY = "INV020"
WRONG_VALUE = "INV021"
MISSING_KEY = "INV022"
BAD_RANGE = "INV030"
NODE_TWICE = "INV031"
UNKNOWN_GROUP = "INV032"
GROUP_CYCLE = "INV033"
UNKNOWN_HARDWARE = "INV034"
UNKNOWN_RADIO = "INV035"
BAD_ADDRESS = "INV036"
UNKNOWN_MESH = "INV037"
CSV_TABLE = "INV040"
TOO_MANY_ERRORS = "INV099"

# Bounds the time that a file that is not an inventory can cost.
MAX_DIAGNOSTICS = 1000

# One line each, for `meshctl lint --explain` and docs/inventory.md.
MEANINGS = {
    UNREADABLE: "A file of the inventory cannot be read.",
    TOO_LARGE: "A file of the inventory exceeds the size limit.",
    NOT_TEXT: "A file of the inventory is not UTF-8 text, or contains control characters.",
    YAML_SYNTAX: "A file of the inventory is not valid YAML; the rest of the file was not read.",
    YAML_FEATURE: "Unsupported YAML: tags, merge keys, multiple documents, keys that are not text.",
    DUPLICATE_KEY: "A mapping contains a key twice.",
    TOO_MANY_VALUES: "The inventory exceeds the limit of values, as written or with aliases expanded.",
    TOO_DEEP: "The inventory exceeds the nesting limit.",
    EMPTY: "The inventory is empty.",
    INCLUDE: "An include cannot be followed: a cycle, too many files, or a path that is not allowed.",
    INCLUDE_CLASH: "Two files of the inventory set the same key.",
    UNKNOWN_KEY: "An unknown key, often a typo.",
    WRONG_VALUE: "A value of the wrong type, or out of range.",
    MISSING_KEY: "A required key is missing.",
    BAD_RANGE: "A range such as `b[01-12]` is invalid, or expands to more names than the limit.",
    NODE_TWICE: "Two ranges expand to the same node.",
    UNKNOWN_GROUP: "A group that is not defined.",
    GROUP_CYCLE: "The inheritance of groups has a cycle.",
    UNKNOWN_HARDWARE: "A node's hardware is not defined.",
    UNKNOWN_RADIO: "A node sets a radio that its hardware does not have.",
    BAD_ADDRESS: "A node's address cannot be determined.",
    UNKNOWN_MESH: "A radio joins a mesh that is not defined; lint reports it as MC101.",
    CSV_TABLE: "A CSV table for `meshctl inventory import` has a wrong heading, value or node.",
    TOO_MANY_ERRORS: "Too many errors: the rest is not reported.",
}


def error(
    code: str,
    position: Position,
    message: str,
    *,
    path: str = "",
    expected: str = "",
    found: str = "",
    hint: str = "",
) -> Diagnostic:
    """An error of the loader, which reports nothing but errors."""
    return Diagnostic(code, Severity.ERROR, position, message, path, expected, found, hint)


def too_many(position: Position) -> Diagnostic:
    """The last diagnostic if not everything is reported."""
    return error(TOO_MANY_ERRORS, position, f"more than {MAX_DIAGNOSTICS} errors; fix these first")
