"""Trailers: what fwtool wrote is read, what is written fwtool reads, and any bytes give an answer."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.firmware import (
    DamagedImage,
    TrailerType,
    append_metadata,
    append_signature,
    parse_metadata,
    read_metadata,
    read_trailers,
)

VECTORS = Path(__file__).parent / "vectors"
# 96 bytes, then metadata by `fwtool -I`, then a signature by `fwtool -S`
IMAGE = (VECTORS / "image.bin").read_bytes()
BODY = b"K" * 96


def test_trailers_written_by_fwtool_are_read() -> None:
    signature, info = read_trailers(IMAGE)
    assert (signature.type, signature.data, signature.is_intact) == (TrailerType.SIGNATURE, b"ucert goes here", True)
    assert (info.type, info.data, info.is_intact) == (
        TrailerType.INFO,
        (VECTORS / "metadata.json").read_bytes(),
        True,
    )


def test_an_appended_signature_matches_fwtool_byte_for_byte() -> None:
    info = read_trailers(IMAGE)[1]
    size = len(BODY) + 8 + len(info.data) + 16
    # the JSON of the vector ends in a line end, which is part of what fwtool was given
    assert append_signature(IMAGE[:size], b"ucert goes here") == IMAGE


def test_metadata_has_board_release_revision_and_target() -> None:
    metadata = read_metadata(IMAGE)
    assert metadata is not None
    assert metadata.boards == ("compex,wpj344-16m", "wpj344")
    assert (metadata.version, metadata.revision) == ("23.05.5", "r24106-10cc5e5e21")
    assert (metadata.target, metadata.profile, metadata.compat_version) == ("ath79/generic", "compex_wpj344-16m", "1.0")


def test_boards_of_an_incompatible_image_are_read_from_new_supported_devices() -> None:
    image = append_metadata(
        BODY,
        {"compat_version": "2.0", "supported_devices": ["Image version mismatch"], "new_supported_devices": ["a,b"]},
    )
    metadata = read_metadata(image)
    assert metadata is not None
    assert metadata.boards == ("a,b",)
    assert metadata.compat_version == "2.0"


def test_an_image_without_trailers_has_no_metadata() -> None:
    assert read_trailers(BODY) == ()
    assert read_metadata(BODY) is None
    assert read_metadata(b"") is None


@pytest.mark.parametrize("at", [0, 50, 95])
def test_a_modified_image_fails_the_checksum(at: int) -> None:
    changed = bytearray(IMAGE)
    changed[at] ^= 1
    with pytest.raises(DamagedImage, match="checksum"):
        read_metadata(bytes(changed))


def test_a_cut_image_has_no_trailer() -> None:
    assert read_metadata(IMAGE[:-1]) is None


@given(st.binary(max_size=64), st.dictionaries(st.text(max_size=5), st.text(max_size=5), max_size=3))
def test_appended_metadata_reads_back(body: bytes, extra: dict[str, str]) -> None:
    image = append_metadata(body, {**extra, "supported_devices": ["x,y"], "version": {}, "compat_version": "1.0"})
    metadata = read_metadata(append_signature(image, b"s"))
    assert metadata is not None
    assert metadata.boards == ("x,y",)


@given(st.binary(max_size=40), st.integers(0, 2**32 - 1), st.integers(0, 255), st.integers(0, 2**32 - 1))
def test_an_arbitrary_trailer_raises_only_damaged_image(body: bytes, crc: int, kind: int, size: int) -> None:
    trailer = b"FWx0" + crc.to_bytes(4, "big") + bytes([kind, 0, 0, 0]) + size.to_bytes(4, "big")
    with suppress(DamagedImage):
        read_trailers(body + trailer)


@given(st.one_of(st.binary(max_size=40), st.from_regex(rb'\{"(version|supported_devices)": ?[\[{"1a-z\]}]{0,9}\}')))
def test_arbitrary_metadata_raises_only_damaged_image(text: bytes) -> None:
    with suppress(DamagedImage):
        parse_metadata(text)


def test_oversized_metadata_and_signatures_are_rejected() -> None:
    with pytest.raises(ValueError, match="at most"):
        append_metadata(BODY, {"x": "y" * 31_000})
    with pytest.raises(ValueError, match="at most"):
        append_signature(BODY, bytes(1025))
