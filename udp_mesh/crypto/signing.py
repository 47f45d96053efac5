"""Signatures of log items (Ed25519, RFC 8032): each log has a key pair of its own, and its public key names it.

A node that relays an item can verify it and cannot change it, even with the fleet's key; rotating that key leaves
stored items valid.
"""

from __future__ import annotations

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

SEED_BYTES = 32
PUBLIC_KEY_BYTES = 32
SIGNATURE_BYTES = 64


class SigningKey:
    """One log's key pair, from its secret seed of 32 random bytes."""

    __slots__ = ("_private", "public")

    def __init__(self, seed: bytes) -> None:
        """Raises ValueError unless the seed has 32 bytes."""
        if len(seed) != SEED_BYTES:
            raise ValueError(f"seed: expected {SEED_BYTES} bytes, found {len(seed)}")
        self._private = Ed25519PrivateKey.from_private_bytes(seed)
        self.public = self._private.public_key().public_bytes_raw()

    def sign(self, data: bytes) -> bytes:
        return self._private.sign(data)


def is_signed(public: bytes, signature: bytes, data: bytes) -> bool:
    """Whether the holder of this public key signed the data. Any bytes are accepted."""
    try:
        Ed25519PublicKey.from_public_bytes(public).verify(signature, data)
    except (InvalidSignature, ValueError):
        return False
    return True
