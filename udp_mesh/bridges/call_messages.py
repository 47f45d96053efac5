"""Messages of calls between bridges, for services and actions: a JSON object and bytes. Pure.

`Offers` lists what a robot offers, `Call` and `Reply` carry a request and its response, `Event` carries a message of an
action's topics (feedback, status). `run` names one run of a bridge: numbers of different runs are never compared.
Format: length of the JSON object (u16, big-endian), the object, the bytes of ROS.
"""

from __future__ import annotations

import json
import struct
from typing import Any, Dict, NamedTuple, Tuple, Union

MAX_OFFERS = 256
"""Services per robot: a peer can invent names."""
MAX_TEXT = 1000
_LENGTH = struct.Struct(">H")

SETTINGS = {"priority": 2, "reliable": True, "compression": True, "deadline_s": 30.0}
"""Settings of the calls' mesh topic; an entry in the daemon's `[topics]` replaces them."""


class Offer(NamedTuple):
    """`type` is `pkg/srv/Type` (ROS 2) or `pkg/Type` (ROS 1), `checksum` its md5sum in ROS 1. `timeout_s` 0: a call may
    take as long as the peer is online, and `lost_s` longer."""

    name: str
    type: str
    checksum: str
    timeout_s: float
    lost_s: float = 0.0


class Offers(NamedTuple):
    """`answer`: whether to reply with the addressee's own."""

    run: str
    offers: Tuple[Offer, ...]
    answer: bool


class Call(NamedTuple):
    run: str
    number: int
    name: str
    request: bytes


class Reply(NamedTuple):
    """`error` is "" for a response."""

    run: str
    number: int
    error: str
    response: bytes


class Event(NamedTuple):
    name: str
    payload: bytes


CallMessage = Union[Offers, Call, Reply, Event]


class CallMessageError(ValueError):
    """These bytes are not a valid message."""


def encode_call_message(message: CallMessage) -> bytes:
    payload = b""
    if isinstance(message, Offers):
        head: Dict[str, Any] = {"op": "offers", "run": message.run, "answer": message.answer}
        head["offers"] = [list(offer) for offer in message.offers[:MAX_OFFERS]]
    elif isinstance(message, Call):
        head, payload = {"op": "call", "run": message.run, "number": message.number, "name": message.name}, message[3]
    elif isinstance(message, Reply):
        head, payload = {"op": "reply", "run": message.run, "number": message.number}, message.response
        head["error"] = message.error[:MAX_TEXT]
    else:
        head, payload = {"op": "event", "name": message.name}, message.payload
    text = json.dumps(head, separators=(",", ":")).encode()
    if len(text) > 0xFFFF:
        raise CallMessageError("expected at most 65535 bytes of names, found {}".format(len(text)))
    return _LENGTH.pack(len(text)) + text + payload


def decode_call_message(data: bytes) -> CallMessage:
    """Raises CallMessageError."""
    try:
        (size,) = _LENGTH.unpack_from(data)
        head = json.loads(data[_LENGTH.size : _LENGTH.size + size].decode())
        payload = data[_LENGTH.size + size :]
        op = head["op"]
        if op == "offers":
            offers = tuple(_offer(*values) for values in head["offers"][:MAX_OFFERS])
            return Offers(_text(head["run"]), offers, head["answer"] is True)
        if op == "call":
            return Call(_text(head["run"]), int(head["number"]), _text(head["name"]), payload)
        if op == "reply":
            return Reply(_text(head["run"]), int(head["number"]), _text(head["error"]), payload)
        if op == "event":
            return Event(_text(head["name"]), payload)
    except (struct.error, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise CallMessageError("not a message of a call: {!r}".format(error)) from error
    raise CallMessageError("op: expected offers, call, reply or event, found {!r}".format(op))


def _offer(name: object, type_name: object, checksum: object, timeout_s: object, lost_s: object) -> Offer:
    times = (float(str(timeout_s)), float(str(lost_s)))
    if not all(0 <= value < 1e6 for value in times):
        raise ValueError("expected times of 0 to 1000000 s")
    return Offer(_text(name), _text(type_name), _text(checksum), *times)


def _text(value: object) -> str:
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        raise ValueError("expected text of at most {} characters".format(MAX_TEXT))
    return value
