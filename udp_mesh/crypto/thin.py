"""Seals the frames of thin links: AES-128-CCM (RFC 3610) with a tag of 4 bytes, one key for each boot of each sender.

The key is derived from the fleet key and the sender's boot tag (64 random bits per run), so that neither restarted
counters nor two nodes that were given one number by mistake use a nonce twice under one key.
"""

from __future__ import annotations

import hmac

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from udp_mesh.crypto.channel import OpenError
from udp_mesh.crypto.keys import Key
from udp_mesh.wire.thin import HINT_MASK, THIN_TAG_BYTES

_KEY_BYTES = 16
_NONCE_BYTES = 13


def thin_hint(key: Key) -> int:
    """7 public bits that distinguish fleets, and the two live keys, before anything is decrypted."""
    return hmac.digest(key.prk, b"thin 1 hint", "sha256")[0] & HINT_MASK


class ThinChannel:
    """Seals or opens the frames of one boot of one sender."""

    __slots__ = ("_cipher", "_number", "key")

    def __init__(self, key: Key, boot_tag: bytes, number: int) -> None:
        self.key = key
        self._number = number
        # HKDF-Expand (RFC 5869) of one block.
        expanded = hmac.digest(key.prk, b"thin 1" + boot_tag + b"\x01", "sha256")
        self._cipher = AESCCM(expanded[:_KEY_BYTES], tag_length=THIN_TAG_BYTES)

    def seal(self, header: bytes, items: bytes, counter: int) -> bytes:
        """The frame; a counter must never be used twice."""
        return header + self._cipher.encrypt(self._nonce(counter), items, header)

    def open(self, frame: bytes, header_bytes: int, counter: int) -> bytes:
        """The items. Raises `OpenError`."""
        try:
            return self._cipher.decrypt(self._nonce(counter), frame[header_bytes:], frame[:header_bytes])
        except (InvalidTag, ValueError) as error:
            raise OpenError("thin frame: cannot be opened") from error

    def _nonce(self, counter: int) -> bytes:
        return bytes((self._number,)) + counter.to_bytes(_NONCE_BYTES - 1, "big")
