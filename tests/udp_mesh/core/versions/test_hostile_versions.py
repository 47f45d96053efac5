"""Versions made by a faulty or hostile peer: refused, within bounds, and nothing wrong is delivered."""

from __future__ import annotations

import sys

from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.versions.receiving import TOPIC, receive, receiver
from udp_mesh.core.versions.encoding import Version, encode
from udp_mesh.core.zstd import DECOMPRESS_STEP_BYTES, ZstdDecompression
from udp_mesh.wire.frames import MessageFlag, RefuseReason
from udp_mesh.wire.version import NO_BASE, VersionHeader, encode_version, version_hash

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

PACKED = MessageFlag.VERSION | MessageFlag.COMPRESSED | MessageFlag.ZSTD


@given(st.binary(max_size=400), st.integers(0, 255))
def test_any_bytes_are_refused_or_have_their_hash(body: bytes, flags: int) -> None:
    result = receive(receiver(), body, flags)
    assert isinstance(result, RefuseReason) or version_hash(result) == body[4:12]


@given(st.binary(min_size=32, max_size=2000), st.binary(max_size=2000), st.integers(0, 1 << 30), st.integers(1, 255))
def test_a_difference_with_a_changed_byte_is_never_another_version(old: bytes, new: bytes, at: int, flip: int) -> None:
    versions = receiver()
    base = Version(version_hash(old), old)
    versions.held.keep(TOPIC, base)
    sent = encode(new, base, compression=False)
    assert receive(versions, sent.body, sent.flags) == new
    damaged = bytearray(sent.body)
    damaged[at % len(damaged)] ^= flip
    result = receive(versions, bytes(damaged), sent.flags)
    assert isinstance(result, RefuseReason) or result == new


def test_a_bomb_costs_one_step_beyond_the_stated_size() -> None:
    bomb = zstd.compress(bytes(50 << 20))
    body = encode_version(VersionHeader(NO_BASE, bytes(8)), bomb)
    assert receive(receiver(message_bytes=1 << 20), body, PACKED) is RefuseReason.CORRUPT
    decompression = ZstdDecompression(bomb, 1 << 20)
    assert decompression.step()
    assert decompression.held_bytes <= len(bomb) + DECOMPRESS_STEP_BYTES


def test_a_frame_without_its_size_is_refused() -> None:
    compressor = zstd.ZstdCompressor()
    stream = compressor.compress(bytes(1000)) + compressor.flush()
    assert zstd.get_frame_info(stream).decompressed_size is None
    assert receive(receiver(), encode_version(VersionHeader(NO_BASE, version_hash(bytes(1000))), stream), PACKED) is (
        RefuseReason.CORRUPT
    )


def test_a_base_too_short_for_zstd_is_not_held() -> None:
    versions = receiver()
    tiny = encode(b"abc", None, compression=False)
    assert receive(versions, tiny.body, tiny.flags) == b"abc"
    body = encode_version(VersionHeader(tiny.digest[:4], tiny.digest), zstd.compress(b"abc"))
    assert receive(versions, body, PACKED) is RefuseReason.FORGOTTEN
