"""SSH logins: `Credentials` become `LoginAttempt`s, in the order they are tried.

OpenWrt's dropbear closes the connection after three refused attempts (`MaxAuthTries` in its init script), so the caller
makes at most that many on one connection. dropbear does not count `auth_none`, which comes first at first contact.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import paramiko
from cryptography.exceptions import UnsupportedAlgorithm
from paramiko.pkey import PKey, UnknownKeyType

from meshctl.device.connection import Credentials, OwnKey, fingerprint_of
from meshctl.device.file_state import FileState, file_state
from meshctl.device.legacy_rsa import with_sha1
from meshctl.errors import InputError
from meshctl.model import Secret

# Every SSH agent and server of the last years knows it (RFC 8332).
_RSA_SIGNATURE = "rsa-sha2-512"


@dataclass(frozen=True, slots=True)
class LoginAttempt:
    """One login attempt with a key, a password, or neither (no authentication); `name` is for messages."""

    name: str
    key: PKey | None = None
    password: Secret | None = None

    def run(self, transport: paramiko.Transport, user: str) -> None:
        """Return once the server accepts the login. Raises what paramiko raises."""
        if self.key is not None:
            transport.auth_publickey(user, self.key)
        elif self.password is not None:
            transport.auth_password(user, self.password.reveal())
        else:
            transport.auth_none(user)


@contextmanager
def login_attempts(credentials: Credentials, *, legacy_rsa_sha1: bool) -> Iterator[tuple[LoginAttempt, ...]]:
    """All attempts, while the agent's socket is open. Raises InputError for an unusable key file."""
    agent = paramiko.Agent() if credentials.use_agent else None
    try:
        found: list[LoginAttempt] = []
        if credentials.empty_password:
            found.append(LoginAttempt("no password"))
        for path in credentials.key_files:
            key = load_key(path, credentials.passphrase)
            found.append(LoginAttempt(f"key {path}", with_sha1(key) if legacy_rsa_sha1 else key))
        if agent is not None:
            found += [LoginAttempt(f"agent key {key.comment or key.get_name()}", key) for key in agent.get_keys()]
        if credentials.password is not None:
            found.append(LoginAttempt("password", password=credentials.password))
        if credentials.empty_password:
            found.append(LoginAttempt("empty password", password=Secret("")))
        yield tuple(found)
    finally:
        if agent is not None:
            agent.close()


def own_keys(credentials: Credentials) -> tuple[OwnKey, ...]:
    """The public parts of all keys that would be tried. Raises InputError for an unusable key file."""
    with login_attempts(credentials, legacy_rsa_sha1=False) as found:
        return tuple(
            OwnKey(identity.name, identity.key.get_name(), identity.key.asbytes())
            for identity in found
            if identity.key is not None
        )


def sign(credentials: Credentials, fingerprints: Collection[str], data: bytes) -> tuple[OwnKey, bytes] | None:
    """`data` signed by the first key that would be tried and has one of the fingerprints (`SHA256:...`); None without
    such a key. The signature is that of RFC 4253 section 6.6, as in SSH's public key login. Raises InputError for an
    unusable key file."""
    with login_attempts(credentials, legacy_rsa_sha1=False) as found:
        for identity in found:
            if identity.key is None or fingerprint_of(identity.key.asbytes()) not in fingerprints:
                continue
            algorithm = _RSA_SIGNATURE if identity.key.get_name() == "ssh-rsa" else None
            try:
                signed = identity.key.sign_ssh_data(data, algorithm)
            except (paramiko.SSHException, OSError) as error:
                raise InputError(f"{identity.name} does not sign: {error}") from error
            own = OwnKey(identity.name, identity.key.get_name(), identity.key.asbytes())
            return own, signed if isinstance(signed, bytes) else signed.asbytes()
    return None


def is_signed_by(key_type: str, blob: bytes, data: bytes, signature: bytes) -> bool:
    """Whether a public key, as in authorized_keys, has signed `data` (see `sign`)."""
    try:
        return bool(PKey.from_type_string(key_type, blob).verify_ssh_sig(data, paramiko.Message(signature)))
    except (paramiko.SSHException, UnknownKeyType, UnsupportedAlgorithm, ValueError, IndexError):
        return False


def new_key_pair(comment: str) -> tuple[bytes, str]:
    """A new Ed25519 key: the private key as OpenSSH's key file, and the public key as in authorized_keys."""
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    key = Ed25519PrivateKey.generate()
    form = serialization.PrivateFormat.OpenSSH
    private = key.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption())
    openssh = serialization.Encoding.OpenSSH
    public = key.public_key().public_bytes(openssh, serialization.PublicFormat.OpenSSH)
    return private, f"{public.decode()} {comment}"


# File, its state and passphrase -> parsed key. Checking an RSA key, or deriving the key of an encrypted file, takes
# longer than the whole SSH handshake, and the nodes of a fleet share a few key files.
_parsed_keys: dict[tuple[Path, FileState, Secret | None], PKey] = {}
_parse_lock = threading.Lock()


def load_key(path: Path, passphrase: Secret | None) -> PKey:
    """The private key of a file in OpenSSH or PEM format, parsed once per process and again after the file changed.
    Thread-safe; a key may sign in several threads. Raises InputError with the fault."""
    # parsed under the lock: threads that start together wait for the first instead of parsing the same file
    with _parse_lock:
        try:
            identity = (path, file_state(path), passphrase)
        except OSError:
            return _parse_key(path, passphrase)
        if identity not in _parsed_keys:
            _parsed_keys[identity] = _parse_key(path, passphrase)
        return _parsed_keys[identity]


def _parse_key(path: Path, passphrase: Secret | None) -> PKey:
    try:
        return PKey.from_path(path, None if passphrase is None else passphrase.reveal().encode())  # type: ignore[arg-type]
    except FileNotFoundError as error:
        raise InputError(f"{path}: key file not found") from error
    except (paramiko.PasswordRequiredException, TypeError) as error:
        raise InputError(
            f"{path}: the key is encrypted and needs a passphrase, or is not encrypted and a passphrase was given"
        ) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a private key: {error.strerror or error}") from error
    except (UnknownKeyType, UnsupportedAlgorithm) as error:
        raise InputError(f"{path}: cannot be used as a private key: {error}") from error
    except (paramiko.SSHException, ValueError) as error:
        if passphrase is not None:
            raise InputError(f"{path}: the passphrase is wrong, or the file is damaged") from error
        if _is_public_key(path):
            hint = f"name the private key: {path.with_suffix('')}" if path.suffix == ".pub" else "name the private key"
            raise InputError(f"{path}: is a public key, and a login needs the private one", hint=hint) from error
        message = "is not a private key in OpenSSH or PEM format, or a damaged one"
        raise InputError(f"{path}: {message}", hint="`ssh-keygen -t ed25519` makes one") from error


def _is_public_key(path: Path) -> bool:
    try:
        first = path.read_bytes()[:64].split(b" ", 1)[0]
    except OSError:
        return False
    return first.startswith((b"ssh-", b"ecdsa-sha2-", b"sk-"))
