"""RSA with SHA-1, only for OpenWrt 19.07.

dropbear 2019.78 of 19.07 signs and accepts RSA only with SHA-1 (`ssh-rsa`, RFC 4253 section 6.6); rsa-sha2-256 came
with dropbear 2020.79. paramiko 5 removed that algorithm: its RSA key does not sign or verify it, and its transport does
not offer it. `LegacyTransport` and `LegacyRsaKey` restore exactly that, for host keys and user keys. To prevent a
downgrade, `ssh.connect` uses them only if the caller requests it, or the node's release is 19.07 and it offers nothing
else.
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
    """A transport that offers `ssh-rsa` last, and signs with it if the server supports nothing else."""

    _preferred_keys = (*paramiko.Transport._preferred_keys, SSH_RSA)  # type: ignore[attr-defined]
    _preferred_pubkeys = (*paramiko.Transport._preferred_pubkeys, SSH_RSA)  # type: ignore[attr-defined]
    _key_info: ClassVar[dict[str, type[PKey]]] = {
        **paramiko.Transport._key_info,  # type: ignore[attr-defined]
        SSH_RSA: LegacyRsaKey,
    }

    @property
    def preferred_pubkeys(self) -> tuple[str, ...]:
        """`ssh-rsa` first for a server with only an `ssh-rsa` host key: it sends no list of accepted algorithms."""
        usual: tuple[str, ...] = self._filter_algorithm("pubkeys")  # type: ignore[attr-defined]
        if self.host_key_type != SSH_RSA:
            return usual
        return (SSH_RSA, *(name for name in usual if name != SSH_RSA))


def with_sha1(key: PKey) -> PKey:
    """The key, with `ssh-rsa` signatures if it is an RSA key from a file; an agent's key supports them already."""
    return LegacyRsaKey(key=key.key) if type(key) is paramiko.RSAKey else key
