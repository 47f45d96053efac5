"""OpenWrt's usign signatures: Ed25519 in signify's file format (usign's main.c).

A file is a line `untrusted comment: ...` and a line of base64: `Ed`, 8 bytes of key id, then 32 bytes of public key or
64 bytes of signature.
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass

_ALGORITHM = b"Ed"
_NAME_BYTES = 8
_KEY_BYTES = 32
_SIGNATURE_BYTES = 64


class BadSignature(ValueError):
    """An unreadable key or signature, or a signature that does not match; the text says which."""


@dataclass(frozen=True, slots=True)
class PublicKey:
    """`name` is the 8-byte key id in signatures."""

    name: bytes
    key: bytes


def parse_public_key(text: str) -> PublicKey:
    """Parse a `.pub` file. Raises BadSignature."""
    name, key = _parts(text, "public key", _KEY_BYTES)
    return PublicKey(name, key)


def verify(message: bytes, signature: str, key: PublicKey) -> None:
    """Return if `signature`, a `.sig` file's text, is valid for `message` and `key`. Raises BadSignature otherwise."""
    # only inventories with signed images need it
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    name, value = _parts(signature, "signature", _SIGNATURE_BYTES)
    if name != key.name:
        raise BadSignature(f"expected a signature by key {key.name.hex()}, found one by {name.hex()}")
    try:
        Ed25519PublicKey.from_public_bytes(key.key).verify(value, message)
    except (InvalidSignature, ValueError) as error:
        raise BadSignature(f"the signature by key {key.name.hex()} does not match") from error


def _parts(text: str, what: str, size: int) -> tuple[bytes, bytes]:
    lines = text.splitlines()
    if len(lines) < 2 or not lines[0].startswith("untrusted comment:"):
        raise BadSignature(f"expected a usign {what} (a comment line and a line of base64), found something else")
    try:
        raw = base64.b64decode(lines[1], validate=True)
    except (binascii.Error, ValueError) as error:
        raise BadSignature(f"expected a line of base64 in the usign {what}: {error}") from error
    if len(raw) != len(_ALGORITHM) + _NAME_BYTES + size or not raw.startswith(_ALGORITHM):
        raise BadSignature(f"expected an Ed25519 {what}, found {len(raw)} bytes that start with {raw[:2]!r}")
    start = len(_ALGORITHM) + _NAME_BYTES
    return raw[len(_ALGORITHM) : start], raw[start:]
