"""The wire vectors of shared logs, for `make_vectors`: control messages and signed items."""

from __future__ import annotations

import struct

from udp_mesh.core.logs.item import MAX_NUMBER, ItemId, LogItem, LogKey, encode_item
from udp_mesh.core.logs.messages import (
    MAX_ENTRIES,
    MAX_HOLDERS,
    MAX_ORDER,
    MAX_RANGES,
    Have,
    HaveEntry,
    Holder,
    ItemRequest,
    encode_control,
)
from udp_mesh.crypto.signing import SigningKey

SEED = bytes(range(32))
KEY = SigningKey(SEED)
OTHER_KEY = SigningKey(bytes(32))
ARTIFACTS = LogKey("artifacts", "spot1", KEY.public)
STATES = LogKey("zustände", "husky", OTHER_KEY.public)

CONTROL: dict[str, Have | ItemRequest] = {
    "holds nothing, has just met": Have((), complete=True, asks=True, order=1),
    "holds ranges": Have((HaveEntry(ARTIFACTS, ((1, 7), (9, 9))),), order=MAX_ORDER),
    "knows what readers have": Have(
        (
            HaveEntry(
                ARTIFACTS,
                ((1, 1), (MAX_NUMBER - 9, MAX_NUMBER)),
                (Holder("base", ((1, 3),)), Holder("rover", ())),
                True,
            ),
            HaveEntry(STATES, ()),
        ),
        complete=True,
    ),
    "requests items": ItemRequest(((ARTIFACTS, ((8, 8), (10, 12))), (STATES, ((1, 1),)))),
}
ITEMS: dict[str, tuple[SigningKey, LogItem]] = {
    "first item": (KEY, LogItem(ItemId(ARTIFACTS, 1), 1_700_000_000_000, "std_msgs/String", b"rope at 12, 4")),
    "empty, without a type": (OTHER_KEY, LogItem(ItemId(STATES, MAX_NUMBER), 0, "", b"")),
}


def _text(text: bytes) -> bytes:
    return bytes((len(text),)) + text


_LOG = _text(b"artifacts") + _text(b"spot1") + KEY.public


def _request(*ranges: tuple[int, int], count: int | None = None, entries: int = 1) -> bytes:
    packed = b"".join(struct.pack(">QI", first, length) for first, length in ranges)
    return struct.pack(">BH", 2, entries) + _LOG + struct.pack(">H", len(ranges) if count is None else count) + packed


def _have(flags: int, holders: bytes) -> bytes:
    return struct.pack(">BBH", 1, 0, 1) + _LOG + bytes((flags,)) + holders


REFUSED_CONTROL: dict[str, bytes] = {
    "nothing at all": b"",
    "unknown kind": b"\x03\x00\x00",
    "a byte too many": _request((1, 1)) + b"\x00",
    "cut short": _request((1, 1))[:-1],
    "number zero": _request((0, 1)),
    "empty range": _request((1, 0)),
    "descending ranges": _request((5, 2), (3, 1)),
    "overlapping ranges": _request((1, 5), (5, 1)),
    "number too large": _request((MAX_NUMBER, 2)),
    "too many ranges": _request(*((2 * number, 1) for number in range(1, MAX_RANGES + 2))),
    "too many entries": struct.pack(">BH", 2, MAX_ENTRIES + 1) + (_LOG + bytes(2)) * (MAX_ENTRIES + 1),
    "too many holders": _have(0, bytes((MAX_HOLDERS + 1,)) + (_text(b"base") + bytes(2)) * (MAX_HOLDERS + 1)),
    "topic that is not UTF-8": struct.pack(">BH", 2, 1) + _text(b"\xff") + _text(b"spot1") + KEY.public + bytes(2),
    "source with a control character": struct.pack(">BH", 2, 1) + _text(b"a") + _text(b"\n") + KEY.public + bytes(2),
}


def refused_items() -> dict[str, tuple[str, bytes]]:
    """Of each the topic on which it arrives, and its bytes."""
    key, item = ITEMS["first item"]
    good = encode_item(key, item)
    topic = item.id.log.topic
    return {
        "of another topic": ("maps", good),
        "changed payload": (topic, good[:-1] + bytes((good[-1] ^ 1,))),
        "changed number": (topic, good.replace(struct.pack(">Q", 1), struct.pack(">Q", 2), 1)),
        "another log's id": (topic, good.replace(KEY.public, OTHER_KEY.public, 1)),
        "unknown version": (topic, b"\x02" + good[1:]),
        "cut short": (topic, good[: -len(item.payload) - 1]),
    }


def make_logs() -> object:
    """`control`: messages on `~mesh/log`; `items`: messages on `~mesh/log/NAME`, with the seed of their log's key."""
    return {
        "control": {name: _control(message) for name, message in CONTROL.items()},
        "items": {name: _item(key, item) for name, (key, item) in ITEMS.items()},
        "refused_control": {name: data.hex() for name, data in REFUSED_CONTROL.items()},
        "refused_items": {name: {"topic": topic, "hex": data.hex()} for name, (topic, data) in refused_items().items()},
    }


def _log(log: LogKey) -> dict[str, object]:
    return {"topic": log.topic, "source": log.source, "log_id": log.log_id.hex()}


def _control(message: Have | ItemRequest) -> dict[str, object]:
    encoded = {"hex": encode_control(message).hex()}
    if isinstance(message, ItemRequest):
        entries = [{**_log(log), "ranges": [list(each) for each in ranges]} for log, ranges in message.entries]
        return {"kind": "request", "entries": entries, **encoded}
    held = [
        {
            **_log(entry.log),
            "held": [list(each) for each in entry.held],
            "readers": {holder.reader: [list(each) for each in holder.ranges] for holder in entry.readers},
            "reader_online": entry.reader_online,
        }
        for entry in message.entries
    ]
    flags = {"complete": message.complete, "asks": message.asks, "order": message.order}
    return {"kind": "have", **flags, "entries": held, **encoded}


def _item(key: SigningKey, item: LogItem) -> dict[str, object]:
    seed = SEED if key is KEY else bytes(32)
    return {
        **_log(item.id.log),
        "seed": seed.hex(),
        "number": item.id.number,
        "created_ms": item.created_ms,
        "type_name": item.type_name,
        "payload": item.payload.hex(),
        "hex": encode_item(key, item).hex(),
    }
