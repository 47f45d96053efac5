"""Parse an SSH public key of an authorized_keys line: type, strength, integrity.

The text form is that of OpenSSH's sshd(8), AUTHORIZED_KEYS FILE FORMAT; the blob that of RFC 4253 section 6.6.
"""

from __future__ import annotations

import base64
import binascii
import struct
from dataclasses import dataclass

# RFC 8709 section 4
_ED25519_BYTES = 32
_KINDS = (
    "ssh-ed25519",
    "ssh-rsa",
    "ssh-dss",
    "ecdsa-sha2-nistp256",
    "ecdsa-sha2-nistp384",
    "ecdsa-sha2-nistp521",
    "sk-ssh-ed25519@openssh.com",
    "sk-ecdsa-sha2-nistp256@openssh.com",
)


class BadKey(ValueError):
    """Not a public key; the message gives the reason but never the text."""


@dataclass(frozen=True, slots=True)
class AuthorizedKey:
    """`bits` is the modulus size of an RSA or DSA key, 256 and so on for others; `comment` usually names the owner."""

    kind: str
    bits: int
    comment: str
    text: str


def parse_authorized_key(line: str) -> AuthorizedKey:
    """The key on `line`, which may start with options. Raises BadKey."""
    if "PRIVATE KEY" in line:
        raise BadKey("a private key")
    words = line.split()
    start = next((index for index, word in enumerate(words) if word in _KINDS), None)
    if start is None:
        raise BadKey("unknown key type")
    if start + 1 == len(words):
        raise BadKey(f"{words[start]} without key data")
    kind, encoded = words[start], words[start + 1]
    try:
        blob = base64.b64decode(encoded, validate=True)
    except binascii.Error as error:
        raise BadKey("truncated or not base64") from error
    fields = _fields(blob)
    if not fields or fields[0] != kind.encode():
        raise BadKey(f"key data is not {kind}")
    return AuthorizedKey(kind, _bits(kind, fields), " ".join(words[start + 2 :]), encoded)


def _fields(blob: bytes) -> list[bytes]:
    fields = []
    offset = 0
    while offset < len(blob):
        if offset + 4 > len(blob):
            raise BadKey("truncated")
        (length,) = struct.unpack_from(">I", blob, offset)
        offset += 4
        if offset + length > len(blob):
            raise BadKey("truncated")
        fields.append(blob[offset : offset + length])
        offset += length
    return fields


def _bits(kind: str, fields: list[bytes]) -> int:
    match kind:
        case "ssh-rsa" | "ssh-dss":
            modulus = fields[2] if kind == "ssh-rsa" and len(fields) == 3 else fields[1] if len(fields) == 5 else b""
            if not modulus:
                raise BadKey("truncated")
            return int.from_bytes(modulus, "big").bit_length()
        case "ssh-ed25519" | "sk-ssh-ed25519@openssh.com":
            if len(fields) < 2 or len(fields[1]) != _ED25519_BYTES:
                raise BadKey("truncated")
            return 256
        case _:
            if len(fields) < 3:
                raise BadKey("truncated")
            # the point is one byte and two coordinates
            return (len(fields[2]) - 1) * 4
