"""Envelopes for an untrusted carrier: only the receiver can read a message, and only the sender can have written it.

A request is signed by an operator's SSH key and sealed (age) for the worker's, which is in the inventory. A reply is
signed by the worker's key and sealed for a key that the operator made for this request. Events of a run have no
secrets: they are signed and not sealed, so that every operator can read them. Sealed messages are compressed first.
"""

from __future__ import annotations

import base64
import binascii
import json
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import pyrage

from meshctl.device.authentication import is_signed_by
from meshctl.device.connection import fingerprint_of
from meshctl.device.trust import HostKey, parse_key
from meshctl.errors import InputError
from meshctl.sites.chunks import MAX_MESSAGE_BYTES

# Signs data: the public key as `TYPE BASE64`, and the signature.
Signer = Callable[[bytes], tuple[str, bytes]]

# In front of what is signed, so that a signature is good for one purpose.
REQUEST = b"meshctl-request-1\n"
REPLY = b"meshctl-reply-1\n"
EVENTS = b"meshctl-events-1\n"


class EnvelopeRefused(InputError):
    """A message that is damaged, not for us, or not from whom it should be."""


@dataclass(frozen=True, slots=True)
class ReplyKey:
    """A key for the replies to one request; `recipient` is its public part."""

    identity: pyrage.x25519.Identity

    @classmethod
    def new(cls) -> ReplyKey:
        return cls(pyrage.x25519.Identity.generate())

    @classmethod
    def load(cls, text: str) -> ReplyKey:
        """Raises EnvelopeRefused."""
        try:
            return cls(pyrage.x25519.Identity.from_str(text))
        except pyrage.IdentityError as error:
            raise EnvelopeRefused(f"not a key for replies: {error}") from error

    @property
    def recipient(self) -> str:
        return str(self.identity.to_public())

    @property
    def text(self) -> str:
        return str(self.identity)


def signed(purpose: bytes, value: Mapping[str, object], signer: Signer) -> bytes:
    text = json.dumps(dict(value), separators=(",", ":"))
    key, signature = signer(purpose + text.encode())
    return json.dumps({"text": text, "key": key, "signature": base64.b64encode(signature).decode()}).encode()


def verified(purpose: bytes, data: bytes, accepted: Iterable[HostKey], who: str) -> dict[str, Any]:
    """The signed value. Raises EnvelopeRefused; `who` should have signed it."""
    try:
        envelope = json.loads(data)
        text, key = str(envelope["text"]), parse_key(str(envelope["key"]))
        signature = base64.b64decode(str(envelope["signature"]), validate=True)
        value = json.loads(text)
    except (ValueError, KeyError, TypeError, binascii.Error) as error:
        raise EnvelopeRefused(f"a damaged message: {error}") from error
    if key not in tuple(accepted):
        raise EnvelopeRefused(f"a message signed by {fingerprint_of(key.blob)}, which is not the key of {who}")
    if not is_signed_by(key.key_type, key.blob, purpose + text.encode(), signature):
        raise EnvelopeRefused(f"a message with a wrong signature of {who}")
    if not isinstance(value, dict):
        raise EnvelopeRefused("a damaged message: expected an object")
    return value


def sealed_for_worker(data: bytes, worker_key: str) -> bytes:
    """Raises InputError for a key that cannot be sealed for."""
    try:
        return bytes(pyrage.encrypt(zlib.compress(data), [pyrage.ssh.Recipient.from_str(worker_key)]))
    except (pyrage.RecipientError, pyrage.EncryptError) as error:
        raise InputError(f"nothing can be sealed for the worker's key: {error}") from error


def opened_by_worker(data: bytes, private_key: bytes) -> bytes:
    """Raises EnvelopeRefused."""
    try:
        opened = bytes(pyrage.decrypt(data, [pyrage.ssh.Identity.from_buffer(private_key)]))
    except (pyrage.DecryptError, pyrage.IdentityError) as error:
        raise EnvelopeRefused(f"a message that is not sealed for this worker: {error}") from error
    return inflated(opened)


def inflated(data: bytes) -> bytes:
    """The decompressed data, if it is no larger than a message may be: nothing proves yet who sent it. Raises
    EnvelopeRefused."""
    stream = zlib.decompressobj()
    try:
        found = stream.decompress(data, MAX_MESSAGE_BYTES)
    except zlib.error as error:
        raise EnvelopeRefused(f"a damaged message: {error}") from error
    if not stream.eof:
        raise EnvelopeRefused(f"a message that is cut, or larger than {MAX_MESSAGE_BYTES >> 20} MiB")
    return found


def sealed_for_reply(data: bytes, recipient: str) -> bytes:
    """Raises EnvelopeRefused."""
    try:
        return bytes(pyrage.encrypt(zlib.compress(data), [pyrage.x25519.Recipient.from_str(recipient)]))
    except (pyrage.RecipientError, pyrage.EncryptError) as error:
        raise EnvelopeRefused(f"not a key for replies: {error}") from error


def opened_replaced(text: str, key: ReplyKey) -> dict[str, Any]:
    """Node -> what a run replaced on it, from the message `replaced` of a run. Raises EnvelopeRefused."""
    try:
        found = json.loads(opened_reply(base64.b64decode(text, validate=True), key))
    except (ValueError, binascii.Error) as error:
        raise EnvelopeRefused(f"a damaged message: {error}") from error
    return found if isinstance(found, dict) else {}


def opened_reply(data: bytes, key: ReplyKey) -> bytes:
    """Raises EnvelopeRefused."""
    try:
        opened = bytes(pyrage.decrypt(data, [key.identity]))
    except pyrage.DecryptError as error:
        raise EnvelopeRefused(f"a reply to another request: {error}") from error
    return inflated(opened)
