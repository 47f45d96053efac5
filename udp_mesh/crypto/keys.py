"""The fleet's keys: 32 secret bytes each, one or two live at a time. The first one seals, all of them open.

Rotation without interruption: every node gets (old, new), then (new, old), then (new,). `Key.unkeyed()` is a
public key: the same format and code without protection. Such nodes cannot communicate with nodes that have a real key,
and report that.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from dataclasses import dataclass, field

from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.header import CHECK_BYTES

SECRET_BYTES = 32
KEY_ID_BYTES = 4

_EXTRACT_SALT = b"udp_mesh wire 1 fleet key"
_UNKEYED_SECRET = hashlib.sha256(b"udp_mesh: no key, no protection").digest()


@dataclass(frozen=True, slots=True, repr=False)
class Key:
    """One fleet key. Its secret never appears in `repr`, messages or logs; `key_id` does."""

    secret: bytes
    prk: bytes = field(init=False, compare=False)
    """HKDF-Extract of the secret (RFC 5869), from which every channel's key is expanded."""
    key_id: bytes = field(init=False, compare=False)
    """4 public bytes that identify the key a peer used."""
    check_key: bytes = field(init=False, compare=False)

    def __post_init__(self) -> None:
        if len(self.secret) != SECRET_BYTES:
            raise ValueError(f"fleet key: expected {SECRET_BYTES} bytes, found {len(self.secret)}")
        prk = hmac.digest(_EXTRACT_SALT, self.secret, "sha256")
        object.__setattr__(self, "prk", prk)
        object.__setattr__(self, "key_id", hmac.digest(prk, b"key id", "sha256")[:KEY_ID_BYTES])
        object.__setattr__(self, "check_key", hmac.digest(prk, b"header check", "sha256"))

    def __repr__(self) -> str:
        return f"Key({self.key_id.hex()})"

    @classmethod
    def parse(cls, text: str) -> Key:
        """Parse a key of 64 hexadecimal digits or 44 characters of base64. Raises ValueError (without the text), and
        TypeError for what is no text, such as the None of a variable that is not set."""
        if not isinstance(text, str):
            raise TypeError(f"key: expected text, found {type(text).__name__}")
        compact = text.strip()
        try:
            if len(compact) == 2 * SECRET_BYTES:
                return cls(bytes.fromhex(compact))
            return cls(base64.b64decode(compact, validate=True))
        except (ValueError, binascii.Error) as error:
            raise ValueError(
                f"expected a key of {SECRET_BYTES} bytes as 64 hexadecimal digits or 44 characters of base64, "
                f"found {len(compact)} characters"
            ) from error

    @classmethod
    def unkeyed(cls) -> Key:
        """The public key of nodes without a key: for testing only."""
        return cls(_UNKEYED_SECRET)

    def check(self, header: bytes | memoryview) -> bytes:
        """The 4-byte keyed hash at the end of a long header (RFC 7693): cheap, and enough to drop invented senders."""
        return hashlib.blake2s(header, key=self.check_key, digest_size=CHECK_BYTES).digest()


class UnknownKeyError(DecodeError):
    """A datagram sealed with a key that is not live here; `key_id` is what it claims (unauthenticated)."""

    def __init__(self, key_id: bytes) -> None:
        super().__init__(f"sealed with unknown key {key_id.hex()}")
        self.key_id = key_id
