"""A ROS message definition as text -> fields and md5sum. Pure.

The text is ROS 1's `_full_text`: the message's own fields, then every message it contains, each after a line of `=` and
`MSG: pkg/Type` (http://wiki.ros.org/msg). The md5sum is that of genmsg: constants first, comments left out, a contained
message replaced by its own md5sum.
"""

from __future__ import annotations

import hashlib
import re
from typing import Dict, List, NamedTuple, Optional, Tuple

BUILTIN = {
    *("bool", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"),
    *("string", "time", "duration", "char", "byte"),
}
HEADER = "std_msgs/Header"
MAX_DEPTH = 20
"""Messages inside of one another; a definition that contains itself has no end."""
_FIELD = re.compile(r"([A-Za-z][A-Za-z0-9_/]*)(\[([0-9]*)\])?\s+([A-Za-z][A-Za-z0-9_]*)")
_CONSTANT = re.compile(r"([a-z0-9]+)\s+([A-Za-z][A-Za-z0-9_]*)\s*=\s*(.*)")
_SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)


class DefinitionError(ValueError):
    """This text is not a complete message definition."""


class Field(NamedTuple):
    """`length`: None for a single value, 0 for an array of any length, else the length of the array."""

    name: str
    type: str
    length: Optional[int]


class _Text(NamedTuple):
    constants: Tuple[str, ...]
    fields: Tuple[Field, ...]


class MessageDefinition:
    """A message with everything it contains."""

    def __init__(self, name: str, text: str) -> None:
        """`name` is `pkg/Type`. Raises DefinitionError."""
        self.name = name
        self.text = text
        parts = _SEPARATOR.split(text)
        self._messages: Dict[str, _Text] = {name: _parse(name, parts[0])}
        for part in parts[1:]:
            first, _, body = part.strip().partition("\n")
            if not first.startswith("MSG: "):
                raise DefinitionError("{}: expected 'MSG: pkg/Type' after a separator, found {!r}".format(name, first))
            contained = first[5:].strip()
            self._messages[contained] = _parse(contained, body)
        self.md5sum = self._md5sum(name, 0)

    def fields(self, name: str) -> Tuple[Field, ...]:
        """The fields of this message or of one it contains. Raises DefinitionError."""
        if name not in self._messages:
            raise DefinitionError("{}: the definition of {} is missing".format(self.name, name))
        return self._messages[name].fields

    def _md5sum(self, name: str, depth: int) -> str:
        if depth > MAX_DEPTH:
            raise DefinitionError("{}: messages are nested deeper than {}".format(self.name, MAX_DEPTH))
        lines = list(self._messages[name].constants) if name in self._messages else []
        for field in self.fields(name):
            if field.type in BUILTIN:
                count = "" if field.length is None else "[{}]".format(field.length or "")
                lines.append("{}{} {}".format(field.type, count, field.name))
            else:
                lines.append("{} {}".format(self._md5sum(field.type, depth + 1), field.name))
        return hashlib.md5("\n".join(lines).encode()).hexdigest()


def _parse(name: str, text: str) -> _Text:
    package = name.partition("/")[0]
    constants: List[str] = []
    fields: List[Field] = []
    for line in text.splitlines():
        bare = line.partition("#")[0].strip()
        # a string constant may contain "#"
        constant = _CONSTANT.fullmatch(line.strip() if line.lstrip().startswith("string") else bare)
        if constant is not None:
            constants.append("{} {}={}".format(constant[1], constant[2], constant[3].strip()))
            continue
        if not bare:
            continue
        found = _FIELD.fullmatch(bare)
        if found is None:
            raise DefinitionError("{}: expected 'TYPE NAME', found {!r}".format(name, bare))
        count = None if found[2] is None else int(found[3] or 0)
        fields.append(Field(found[4], _full_type(found[1], package), count))
    return _Text(tuple(constants), tuple(fields))


def _full_type(base: str, package: str) -> str:
    if base in BUILTIN or "/" in base:
        return base
    return HEADER if base == "Header" else "{}/{}".format(package, base)
