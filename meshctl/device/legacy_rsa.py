"""RSA with SHA-1, for OpenWrt 19.07 alone.

dropbear 2019.78, which 19.07 ships, signs and accepts RSA with SHA-1 only (`ssh-rsa`, RFC 4253 section 6.6);
rsa-sha2-256 came with dropbear 2020.79. paramiko 5 removed that algorithm: its RSA key refuses to sign or verify it and
its transport does not offer it. `LegacyTransport` and `LegacyRsaKey` put back exactly these two things, for host keys
and for user keys. No node may be talked down to it that could do better, so `ssh.connect` uses this class only where
the caller says so, or the node's release is 19.07 and it offers nothing else.
"""

from __future__ import annotations

from typing import ClassVar

import paramiko
from cryptography.hazmat.primitives import hashes
from paramiko.pkey import PKey

SSH_RSA = "ssh-rsa"


class LegacyRsaKey(paramiko.RSAKey):
    """An RSA key that also signs and verifies `ssh-rsa`."""

    HASHES = {**paramiko.RSAKey.HASHES, SSH_RSA: hashes.SHA1}  # type: ignore[misc]  # noqa: RUF012


class LegacyTransport(paramiko.Transport):
    """A transport that offers `ssh-rsa` last, and signs with it where the server can do nothing else."""

    _preferred_keys = (*paramiko.Transport._preferred_keys, SSH_RSA)  # type: ignore[attr-defined]
    _preferred_pubkeys = (*paramiko.Transport._preferred_pubkeys, SSH_RSA)  # type: ignore[attr-defined]
    _key_info: ClassVar[dict[str, type[PKey]]] = {
        **paramiko.Transport._key_info,  # type: ignore[attr-defined]
        SSH_RSA: LegacyRsaKey,
    }

    @property
    def preferred_pubkeys(self) -> tuple[str, ...]:
        """A server that proves itself by `ssh-rsa` alone sends no list of what it accepts, so that goes first."""
        usual: tuple[str, ...] = self._filter_algorithm("pubkeys")  # type: ignore[attr-defined]
        if self.host_key_type != SSH_RSA:
            return usual
        return (SSH_RSA, *(name for name in usual if name != SSH_RSA))


def with_sha1(key: PKey) -> PKey:
    """The key, able to sign `ssh-rsa` if it is an RSA key of a file; an agent's key can do so already."""
    return LegacyRsaKey(key=key.key) if type(key) is paramiko.RSAKey else key
