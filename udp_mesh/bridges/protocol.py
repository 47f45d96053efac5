"""What ROS bridges tell each other, as JSON on a mesh topic of their own. Pure.

`Hello` says which latched messages its sender holds, so that the receiver sends those it lacks; bridges greet when they
start and when a peer comes online. `Want` asks for definitions, `Definition` brings one. Every message repeats what is,
so a lost or a doubled one does no harm.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple, Union

from udp_mesh.bridges.types import MAX_DEFINITION_BYTES, TypeKey

MAX_MESSAGE_BYTES = 1 << 20
"""One message: a definition, or greetings over thousands of latched messages."""
MAX_WANTED_TYPES = 256
"""Definitions asked for at once: bounds what one message can make a peer send."""

TOPIC_SETTINGS = {"priority": 1, "reliable": True, "compression": True, "deadline_s": 60.0}
"""How the topic travels: small, and everything of a new type waits for it."""


class Hello(NamedTuple):
    """`holds`: by mesh topic and publisher, the number of the last latched message that came from whom this is sent to
    (`types.Mark`). `answer`: greet me back."""

    holds: dict[str, dict[str, int]]
    answer: bool


class Want(NamedTuple):
    """Asks for definitions."""

    keys: list[TypeKey]


class Definition(NamedTuple):
    """Brings one."""

    key: TypeKey
    text: str


BridgeMessage = Union[Hello, Want, Definition]


class ProtocolError(ValueError):
    """These bytes are no message of a bridge; says why."""


def encode(message: BridgeMessage) -> bytes:
    if isinstance(message, Hello):
        fields: dict[str, Any] = {"op": "hello", "holds": message.holds, "answer": message.answer}
    elif isinstance(message, Want):
        fields = {"op": "want", "types": [list(key) for key in message.keys[:MAX_WANTED_TYPES]]}
    else:
        fields = {"op": "type", "type": list(message.key), "definition": message.text}
    return json.dumps(fields, separators=(",", ":")).encode()


def decode(data: bytes) -> BridgeMessage:
    """The message in these bytes. Raises ExchangeError."""
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
