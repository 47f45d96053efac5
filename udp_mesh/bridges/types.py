"""A message's type as the bridges put it into the mesh's type field. Pure.

`pkg/Type CHECKSUM [latched:PUBLISHER:NUMBER]`: the checksum is the md5sum in ROS 1 and the QoS in ROS 2. The definition
is sent separately, once per type (`protocol`), and stored by type and checksum. A legacy robot sends `pkg/Type` alone.

The mesh may reorder the messages of a topic. Since the last latched message must win, latched messages are numbered per
publisher.
"""

from __future__ import annotations

import re
from collections import OrderedDict
from typing import NamedTuple

MAX_TYPES = 1024
"""Definitions stored: a robot has some dozens, but a peer can invent names."""
MAX_DEFINITION_BYTES = 1 << 18
"""Size of one definition: the largest of common ROS packages have some 10 kB."""
MAX_DEFINITIONS_BYTES = 16 << 20
"""Size of all definitions together."""
_LATCHED = re.compile(r"latched:([0-9a-f]{1,16}):([0-9]{1,18})")


class TypeKey(NamedTuple):
    """The key of a definition. `checksum` is "" for a legacy robot's message."""

    name: str
    checksum: str


class MeshTopic(NamedTuple):
    """A topic of the daemon, as a bridge knows it. No destinations: all. A shared log has none; its items go to its
    readers."""

    destinations: tuple[str, ...] = ()
    is_log: bool = False
    reliable: bool = True
    keep_last: int | None = None

    @property
    def is_adaptable(self) -> bool:
        """Whether the daemon reports what became of each message, and the newest replaces those before it."""
        return self.reliable and self.keep_last == 1


class LatchMark(NamedTuple):
    """Identifies a latched message: later ones of a publisher have larger numbers. `publisher` is a hex word, a new
    one after each start of the bridge."""

    publisher: str
    number: int


class MessageKind(NamedTuple):
    """A parsed type field. `mark` is None unless the message is latched: late joiners get each publisher's last one."""

    key: TypeKey
    mark: LatchMark | None = None


def kind_text(kind: MessageKind) -> str:
    """Encodes the mesh's type field."""
    words = [kind.key.name]
    if kind.key.checksum:
        words.append(kind.key.checksum)
        if kind.mark is not None:
            words.append("latched:{}:{}".format(*kind.mark))
    return " ".join(words)


def parse_kind(text: str) -> MessageKind | None:
    """Parses a type field; None for a type that was not written by a ROS bridge."""
    words = text.split(" ")
    if not 1 <= len(words) <= 3 or not all(words) or "/" not in words[0].strip("/"):
        return None
    key = TypeKey(words[0], words[1] if len(words) > 1 else "")
    if len(words) < 3:
        return MessageKind(key)
    found = _LATCHED.fullmatch(words[2])
    return None if found is None else MessageKind(key, LatchMark(found[1], int(found[2])))


class Definitions:
    """Definitions by type; the least recently used is dropped first."""

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
        """Stores a definition; False if it is too long."""
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
