"""The number that a message on thin links has, at the beginning of its copies in datagrams (`MessageFlag.NUMBERED`)."""

from __future__ import annotations

from udp_mesh.core.sender.message import AcceptedMessage
from udp_mesh.wire.frames import MessageFlag

NUMBER_BYTES = 2


def numbered(accepted: AcceptedMessage, number: int | None) -> AcceptedMessage:
    """The message with this number (None: without one)."""
    if number is None:
        return accepted
    body = number.to_bytes(NUMBER_BYTES, "big") + accepted.body
    return accepted._replace(body=body, flags=accepted.flags | MessageFlag.NUMBERED)


def unnumbered(accepted: AcceptedMessage) -> AcceptedMessage:
    """The message without its number, for peers that do not accept it."""
    if not accepted.flags & MessageFlag.NUMBERED:
        return accepted
    return accepted._replace(body=accepted.body[NUMBER_BYTES:], flags=accepted.flags & ~MessageFlag.NUMBERED)


def split_number(flags: int, body: bytes) -> tuple[int | None, bytes] | None:
    """A received body's number, if it has one, and the rest. None if it is too short."""
    if not flags & MessageFlag.NUMBERED:
        return None, body
    if len(body) < NUMBER_BYTES:
        return None
    return int.from_bytes(body[:NUMBER_BYTES], "big"), body[NUMBER_BYTES:]
