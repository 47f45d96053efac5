"""Requests of local clients: any split gives the same result, and an invalid frame costs only itself."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.client.mesh_client import MAX_HEADER_BYTES, Frame, encode_frame
from udp_mesh.daemon.framing import BadFrame, RequestReader

LIMIT_BYTES = 100
GOOD = {"op": "peers", "id": 7}


def taken(*pieces: bytes) -> list[Frame | BadFrame]:
    reader = RequestReader(lambda: LIMIT_BYTES)
    return [frame for piece in pieces for frame in reader.feed(piece)]


def frame(head: bytes, payload: bytes = b"") -> bytes:
    return len(head).to_bytes(4, "big") + len(payload).to_bytes(4, "big") + head + payload


@pytest.mark.parametrize(
    ("raw", "request_id", "code"),
    [
        (encode_frame({"op": "publish", "id": 3}, bytes(LIMIT_BYTES + 1)), 3, "too-large"),
        (encode_frame({"op": "publish"}, bytes(LIMIT_BYTES + 1)), None, "too-large"),
        (frame(b"[]", bytes(LIMIT_BYTES + 1)), None, "bad-frame"),
        (frame(b" " * (MAX_HEADER_BYTES + 1), b"x"), None, "bad-frame"),
        (frame(b"{"), None, "bad-frame"),
        (frame(b""), None, "bad-frame"),
        (frame(b"\xff\xfe", b"payload"), None, "bad-frame"),
        (frame(b"[" * MAX_HEADER_BYTES), None, "bad-frame"),
        (frame(json.dumps({"op": "peers", "id": [1]}).encode()), None, "bad-frame"),
    ],
)
def test_a_bad_frame_is_reported_and_the_next_request_is_parsed(raw: bytes, request_id: int | None, code: str) -> None:
    whole = taken(raw + encode_frame(GOOD, b"payload"))
    assert [type(found) for found in whole] == [BadFrame, tuple]
    assert whole[0][:2] == (request_id, code)
    assert whole[1] == (GOOD, b"payload")
    stream = raw + encode_frame(GOOD, b"payload")
    assert taken(*(stream[at : at + 1000] for at in range(0, len(stream), 1000))) == whole


@given(st.lists(st.sampled_from([0, 1, LIMIT_BYTES, LIMIT_BYTES + 1, 3 * LIMIT_BYTES]), max_size=5), st.data())
def test_a_payload_at_the_limit_is_accepted_and_a_larger_one_is_rejected(sizes: list[int], data: st.DataObject) -> None:
    stream = b"".join(encode_frame({"id": number}, bytes(size)) for number, size in enumerate(sizes))
    cuts = sorted(data.draw(st.sets(st.integers(0, len(stream)), max_size=5)))
    pieces = [stream[start:end] for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    assert [found[0] if isinstance(found, BadFrame) else found[0]["id"] for found in taken(*pieces)] == list(
        range(len(sizes))
    )
    assert [isinstance(found, BadFrame) for found in taken(*pieces)] == [size > LIMIT_BYTES for size in sizes]


@given(st.lists(st.binary(max_size=40), max_size=5))
def test_arbitrary_bytes_parse_as_requests_or_bad_frames(pieces: list[bytes]) -> None:
    for found in taken(*pieces):
        assert len(found) in (2, 3)


def test_a_skipped_payload_is_not_buffered() -> None:
    reader = RequestReader(lambda: LIMIT_BYTES)
    (refused,) = reader.feed(frame(b"{}")[:4] + b"\xff\xff\xff\xff{}")
    assert isinstance(refused, BadFrame)
    for _ in range(100):
        assert reader.feed(bytes(100_000)) == []
    assert len(reader._buffer) == 0


@pytest.mark.parametrize("at", [8, 20, 60])
def test_a_discarded_partial_frame_is_skipped_and_the_next_one_is_parsed(at: int) -> None:
    stream = encode_frame({"op": "publish", "id": 3}, bytes(LIMIT_BYTES)) + encode_frame(GOOD, b"payload")
    reader = RequestReader(lambda: LIMIT_BYTES)
    assert reader.feed(stream[:at]) == []
    assert reader.buffered_bytes == at
    assert reader.discard_partial("busy", "try again") == BadFrame(3 if at == 60 else None, "busy", "try again")
    assert reader.buffered_bytes == 0
    assert [frame for byte in stream[at:] for frame in reader.feed(bytes([byte]))] == [(GOOD, b"payload")]
