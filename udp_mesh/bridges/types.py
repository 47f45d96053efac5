"""What a bridge says about a message without reading it: its type, in the mesh's type field. Pure.

`pkg/Type CHECKSUM [latched:PUBLISHER:NUMBER]`: ROS 1 puts the md5sum there, ROS 2 the QoS. The definition crosses
separately, once per type (`exchange`), and is kept here by type and checksum. A fielded robot sends `pkg/Type` alone.

The mesh may deliver a topic's messages in another order than they were sent. Of what is latched the last one must stay,
so latched messages are numbered per publisher.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from typing import NamedTuple

MAX_TYPES = 1024
"""Definitions kept: a robot has some dozens; more is a peer inventing names."""
MAX_DEFINITION_BYTES = 1 << 18
"""One definition: the largest of common ROS packages are some 10 kB."""
MAX_DEFINITIONS_BYTES = 16 << 20
"""All definitions together: as above."""
_LATCHED = re.compile(r"latched:([0-9a-f]{1,16}):([0-9]{1,18})")


class TypeKey(NamedTuple):
    """What a definition is kept by. `checksum` is "" from a fielded robot."""

    name: str
    checksum: str


class Mark(NamedTuple):
    """A latched message's place: the later of one publisher's has the larger number. `publisher` is a hex word, another
    one after each start of the bridge."""

    publisher: str
    number: int


class MessageKind(NamedTuple):
    """A message's type field. `mark`: late subscribers get the last one of each publisher; None: not latched."""

    key: TypeKey
    mark: Mark | None = None


def kind_text(kind: MessageKind) -> str:
    """The mesh's type field."""
    words = [kind.key.name]
    if kind.key.checksum:
        words.append(kind.key.checksum)
        if kind.mark is not None:
            words.append("latched:{}:{}".format(*kind.mark))
    return " ".join(words)


def parse_kind(text: str) -> MessageKind | None:
    """The kind in a type field; None for a type that no ROS bridge wrote."""
    words = text.split(" ")
    if not 1 <= len(words) <= 3 or not all(words) or "/" not in words[0].strip("/"):
        return None
    key = TypeKey(words[0], words[1] if len(words) > 1 else "")
    if len(words) < 3:
        return MessageKind(key)
    found = _LATCHED.fullmatch(words[2])
    return None if found is None else MessageKind(key, Mark(found[1], int(found[2])))


class Definitions:
    """Definitions by type, the longest unused forgotten first."""

    def __init__(self) -> None:
        self._texts: OrderedDict[TypeKey, str] = OrderedDict()
        self._bytes = 0

    def __contains__(self, key: TypeKey) -> bool:
        return key in self._texts

    def get(self, key: TypeKey) -> str | None:
        if key not in self._texts:
            return None
        self._texts.move_to_end(key)
        return self._texts[key]

    def put(self, key: TypeKey, definition: str) -> bool:
        """Keeps it; False where it is too long."""
        size = len(definition.encode())
        if size > MAX_DEFINITION_BYTES:
            return False
        self._forget(key)
        self._texts[key] = definition
        self._bytes += size
        while len(self._texts) > MAX_TYPES or self._bytes > MAX_DEFINITIONS_BYTES:
            self._forget(next(iter(self._texts)))
        return True

    def _forget(self, key: TypeKey) -> None:
        text = self._texts.pop(key, None)
        if text is not None:
            self._bytes -= len(text.encode())
