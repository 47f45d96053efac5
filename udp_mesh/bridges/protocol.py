"""Messages between ROS bridges, as JSON on a mesh topic of their own. Pure.

`Hello` lists the latched messages its sender has, so that the receiver sends the missing ones; bridges send it when
they start and when a peer comes online. `Want` requests definitions, `Definition` carries one. Messages state facts
rather than changes, so loss and duplication are harmless.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple, Union

from udp_mesh.bridges.types import MAX_DEFINITION_BYTES, TypeKey

MAX_MESSAGE_BYTES = 1 << 20
"""Maximum size of a message: a definition, or a `Hello` that lists thousands of latched messages."""
MAX_WANTED_TYPES = 256
"""Definitions requested at a time: bounds what one message can make a peer send."""

TOPIC_SETTINGS = {"priority": 1, "reliable": True, "compression": True, "deadline_s": 60.0}
"""Settings of the bridges' topic: its messages are small, and everything of a new type waits for them."""


class Hello(NamedTuple):
    """`holds`: by mesh topic and publisher, the number of the last latched message received from the addressee
    (`types.LatchMark`). `answer`: whether to reply with a `Hello`."""

    holds: dict[str, dict[str, int]]
    answer: bool


class Want(NamedTuple):
    """Requests definitions."""

    keys: list[TypeKey]


class Definition(NamedTuple):
    """Carries one definition."""

    key: TypeKey
    text: str


BridgeMessage = Union[Hello, Want, Definition]


class ProtocolError(ValueError):
    """These bytes are not a valid message of a bridge."""


def encode(message: BridgeMessage) -> bytes:
    if isinstance(message, Hello):
        fields: dict[str, Any] = {"op": "hello", "holds": message.holds, "answer": message.answer}
    elif isinstance(message, Want):
        fields = {"op": "want", "types": [list(key) for key in message.keys[:MAX_WANTED_TYPES]]}
    else:
        fields = {"op": "type", "type": list(message.key), "definition": message.text}
    return json.dumps(fields, separators=(",", ":")).encode()


def decode(data: bytes) -> BridgeMessage:
    """Decodes a message. Raises ProtocolError."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise ProtocolError("expected at most {} bytes, found {}".format(MAX_MESSAGE_BYTES, len(data)))
    try:
        fields = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ProtocolError("expected JSON: {}".format(error)) from error
    if not isinstance(fields, dict):
        raise ProtocolError("expected an object, found {}".format(type(fields).__name__))
    op = fields.get("op")
    if op == "hello":
        return Hello(_holds(fields.get("holds")), fields.get("answer") is True)
    if op == "want":
        return Want([_key(value) for value in _list(fields.get("types"))[:MAX_WANTED_TYPES]])
    if op == "type":
        text = fields.get("definition")
        if not isinstance(text, str) or len(text) > MAX_DEFINITION_BYTES:
            raise ProtocolError("definition: expected text of at most {} bytes".format(MAX_DEFINITION_BYTES))
        return Definition(_key(fields.get("type")), text)
    raise ProtocolError("op: expected hello, want or type, found {!r}".format(op))


def _list(value: object) -> list[object]:
    if not isinstance(value, list):
        raise ProtocolError("expected a list, found {!r}".format(value))
    return value


def _key(value: object) -> TypeKey:
    if not isinstance(value, list) or len(value) != 2 or not all(isinstance(part, str) for part in value):
        raise ProtocolError("type: expected [name, checksum], found {!r}".format(value))
    return TypeKey(value[0], value[1])


def _holds(value: object) -> dict[str, dict[str, int]]:
    found: dict[str, dict[str, int]] = {}
    for topic, numbers in _object(value).items():
        found[topic] = {}
        for publisher, number in _object(numbers).items():
            if not isinstance(number, int):
                raise ProtocolError("holds: expected a number, found {!r}".format(number))
            found[topic][publisher] = number
    return found


def _object(value: object) -> dict[str, object]:
    if not isinstance(value, dict):
        raise ProtocolError("holds: expected an object, found {!r}".format(value))
    return value
