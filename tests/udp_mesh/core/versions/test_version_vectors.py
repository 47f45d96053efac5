"""The published versions are accepted or refused as stated, and what this code sends has the published form."""

import json

import pytest

from tests.udp_mesh.core.versions.receiving import TOPIC, receive, receiver
from tests.udp_mesh.wire.make_vectors import FOLDER, REFUSED_VERSIONS, VERSIONS
from udp_mesh.core.versions.encoding import Version, encode
from udp_mesh.core.versions.received import ReceivedVersions
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.frames import MessageFlag, RefuseReason
from udp_mesh.wire.version import (
    NO_BASE,
    VERSION_HEADER_BYTES,
    VersionHeader,
    decode_version,
    encode_version,
    version_hash,
)

PUBLISHED = json.loads((FOLDER / "versions.json").read_text())


def holding(base: str | None) -> ReceivedVersions:
    """A receiver that has this version (hexadecimal)."""
    made = receiver()
    if base is not None:
        held = bytes.fromhex(base)
        made.held.keep(TOPIC, Version(version_hash(held), held))
    return made


@pytest.mark.parametrize("name", VERSIONS)
def test_a_published_version_is_decoded(name: str) -> None:
    vector = PUBLISHED["accepted"][name]
    found = receive(holding(vector["base"]), bytes.fromhex(vector["body"]), vector["flags"])
    assert found == bytes.fromhex(vector["payload"])


@pytest.mark.parametrize("name", REFUSED_VERSIONS)
def test_a_published_faulty_version_is_refused_for_its_reason(name: str) -> None:
    vector = PUBLISHED["refused"][name]
    found = receive(holding(vector["base"]), bytes.fromhex(vector["body"]), vector["flags"])
    assert found is RefuseReason(vector["reason"])


@pytest.mark.parametrize("name", VERSIONS)
def test_what_is_sent_has_the_header_and_flags_of_the_published_version(name: str) -> None:
    """All bytes where nothing is compressed; another zstd may compress otherwise."""
    payload, base, flags, body = VERSIONS[name]
    held = None if base is None else Version(version_hash(base), base)
    sent = encode(payload, held, compression=flags & MessageFlag.COMPRESSED != 0)
    assert sent.flags == flags
    same = VERSION_HEADER_BYTES if flags & MessageFlag.COMPRESSED else len(body)
    assert sent.body[:same] == body[:same]
    assert receive(holding(None if base is None else base.hex()), sent.body, sent.flags) == payload


def test_a_header_alone_is_an_empty_version() -> None:
    body = encode_version(VersionHeader(NO_BASE, version_hash(b"")), b"")
    header, content = decode_version(body)
    assert (header.digest, bytes(content)) == (version_hash(b""), b"")
    with pytest.raises(DecodeError, match="found 11"):
        decode_version(body[:-1])
