"""The loader's diagnostic codes, each with what it means; lint rules have codes of their own (`MC...`)."""

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
TOO_MANY_ERRORS = "INV099"

# More than a person reads; bounds the time that a file which is no inventory at all can cost.
MAX_DIAGNOSTICS = 1000

# One line each, for `meshctl lint --explain` and docs/inventory.md.
MEANINGS = {
    UNREADABLE: "A file of the inventory cannot be read.",
    TOO_LARGE: "A file of the inventory is larger than any inventory needs to be.",
    NOT_TEXT: "A file of the inventory is not UTF-8 text, or holds control characters.",
    YAML_SYNTAX: "A file of the inventory is not valid YAML; what follows the place was not read.",
    YAML_FEATURE: "A part of YAML that is refused: tags, merge keys, several documents, keys that are not text.",
    DUPLICATE_KEY: "A key stands twice in one mapping.",
    TOO_MANY_VALUES: "The inventory holds more values than the limit, as written or after its aliases are followed.",
    TOO_DEEP: "The inventory nests deeper than any inventory needs to.",
    EMPTY: "The inventory is empty.",
    INCLUDE: "An include cannot be followed: it names itself in a circle, nests too deep, or leads nowhere.",
    INCLUDE_CLASH: "Two files of the inventory write the same key.",
    UNKNOWN_KEY: "A key that the format does not know; often a slip of the pen.",
    WRONG_VALUE: "A value of the wrong type, or outside its bounds.",
    MISSING_KEY: "A key that must be written is missing.",
    BAD_RANGE: "A range such as `b[01-12]` cannot be read, or makes more names than the limit.",
    NODE_TWICE: "Two ranges make the same node.",
    UNKNOWN_GROUP: "A group that is not defined.",
    GROUP_CYCLE: "Groups inherit from each other in a circle.",
    UNKNOWN_HARDWARE: "A node's hardware is not defined.",
    UNKNOWN_RADIO: "A node sets a radio that its hardware does not have.",
    BAD_ADDRESS: "A node's address cannot be worked out.",
    TOO_MANY_ERRORS: "There are more errors than are reported.",
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
    """An error of the loader; everything it reports is one."""
    return Diagnostic(code, Severity.ERROR, position, message, path, expected, found, hint)


def too_many(position: Position) -> Diagnostic:
    """What stands at the end when not everything is reported."""
    return error(TOO_MANY_ERRORS, position, f"more than {MAX_DIAGNOSTICS} errors; mend these first")
