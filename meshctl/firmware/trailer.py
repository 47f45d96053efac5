"""The trailers at the end of an OpenWrt image: bytes <-> trailers, innermost last (fwtool's fwimage.h and fwtool.c).

A trailer is 16 bytes, big-endian: magic `FWx0`, a CRC-32 of everything before it, its type, and its size including the
data before it. An image may have several, so they are read from the end backwards.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

_TRAILER = struct.Struct(">4sIB3xI")
_MAGIC = b"FWx0"
# version and flags, both 0, before the metadata's JSON
_INFO_HEADER = struct.Struct(">II")
# fwtool's own caps: METADATA_MAXLEN and SIGNATURE_MAXLEN
MAX_METADATA_BYTES = 30 * 1024
MAX_SIGNATURE_BYTES = 1024
_MAX_DATA_BYTES = MAX_METADATA_BYTES + MAX_SIGNATURE_BYTES + 1024


class TrailerType(Enum):
    SIGNATURE = 0
    INFO = 1


@dataclass(frozen=True, slots=True)
class Trailer:
    """`data` is without the info header; `is_intact` is whether the CRC matches."""

    type: TrailerType
    data: bytes
    is_intact: bool


class DamagedImage(ValueError):
    """Inconsistent trailers; the text has the fault."""


def read_trailers(image: bytes) -> tuple[Trailer, ...]:
    """The image's trailers, the last one first.

    Stops after a trailer with a wrong CRC, because nothing before it can be trusted. Raises DamagedImage for an
    impossible size.
    """
    return tuple(_trailers(image))


def _trailers(image: bytes) -> Iterator[Trailer]:
    end = len(image)
    while end >= _TRAILER.size:
        start = end - _TRAILER.size
        magic, crc, kind, size = _TRAILER.unpack_from(image, start)
        if magic != _MAGIC:
            return
        if not _TRAILER.size <= size <= min(end, _MAX_DATA_BYTES + _TRAILER.size):
            raise DamagedImage(f"expected a trailer of at most {min(end, _MAX_DATA_BYTES)} bytes, found {size}")
        is_intact = crc == _crc(image[:start])
        data = image[end - size : start]
        # unknown types are skipped, as fwtool does
        if kind == TrailerType.SIGNATURE.value:
            yield Trailer(TrailerType.SIGNATURE, data, is_intact)
        elif kind == TrailerType.INFO.value:
            yield _info(data, is_intact=is_intact)
        if not is_intact:
            return
        end -= size


def _info(data: bytes, *, is_intact: bool) -> Trailer:
    if len(data) < _INFO_HEADER.size:
        raise DamagedImage(f"expected a metadata header of {_INFO_HEADER.size} bytes, found {len(data)}")
    version, _ = _INFO_HEADER.unpack_from(data)
    if version != 0:
        raise DamagedImage(f"expected metadata of version 0, found {version}")
    return Trailer(TrailerType.INFO, data[_INFO_HEADER.size :], is_intact)


def _crc(data: bytes) -> int:
    """CRC-32 from all ones, without the final inversion."""
    return zlib.crc32(data) ^ 0xFFFFFFFF


def append_metadata(image: bytes, metadata: Mapping[str, object]) -> bytes:
    """The image with metadata appended, as by `fwtool -I`. Raises ValueError if it is too long."""
    text = json.dumps(metadata, separators=(",", ":")).encode()
    if len(text) > MAX_METADATA_BYTES:
        raise ValueError(f"metadata has at most {MAX_METADATA_BYTES} bytes, not {len(text)}")
    return _append(image, _INFO_HEADER.pack(0, 0) + text, TrailerType.INFO)


def append_signature(image: bytes, signature: bytes) -> bytes:
    """The image with a signature appended, as by `fwtool -S`. Raises ValueError if it is too long."""
    if len(signature) > MAX_SIGNATURE_BYTES:
        raise ValueError(f"a signature has at most {MAX_SIGNATURE_BYTES} bytes, not {len(signature)}")
    return _append(image, signature, TrailerType.SIGNATURE)


def _append(image: bytes, data: bytes, kind: TrailerType) -> bytes:
    body = image + data
    return body + _TRAILER.pack(_MAGIC, _crc(body), kind.value, len(data) + _TRAILER.size)
