"""Resolve secret references from the environment, from files, or from files encrypted with age.

Each file is read and decrypted once. Messages never contain content of such a file except the names of its keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, assert_never

from meshctl import event_log
from meshctl.diagnostics import Position
from meshctl.errors import InputError
from meshctl.file_access import special_file
from meshctl.inventory.compose import compose
from meshctl.inventory.source import Source
from meshctl.inventory.tree import MappingNode, Scalar
from meshctl.model import Secret, SecretKind, SecretRef
from meshctl.suggest import did_you_mean

if TYPE_CHECKING:
    import pyrage

# A key file has a few lines.
MAX_SECRET_FILE_BYTES = 1024 * 1024
# The identity file for references without `identity`.
IDENTITY_VARIABLE = "MESHCTL_AGE_IDENTITY"


@dataclass(slots=True)
class SecretStore:
    """`environ` is the process environment; `base` is the directory for references without their own `base`."""

    environ: Mapping[str, str] = field(repr=False)
    base: Path = Path()
    _files: dict[tuple[Path, Path | None], bytes] = field(default_factory=dict, repr=False)

    def get(self, ref: SecretRef, at: Position | None = None) -> Secret:
        """The secret that `ref` refers to. Raises InputError, with the position `at` if given."""
        try:
            value = self._value(ref)
        except _NoSecret as reason:
            place = "" if at is None else f"{at}: "
            raise InputError(f"{place}secret {ref}: {reason}", hint=reason.hint) from None
        event_log.hide(value)
        return Secret(value)

    def _value(self, ref: SecretRef) -> str:
        match ref.kind:
            case SecretKind.ENV:
                value = self.environ.get(ref.where)
                if not value:
                    reason = "is not set" if value is None else "is empty"
                    raise _NoSecret(f"the environment variable {reason}", f"export {ref.where}=...")
                return value
            case SecretKind.FILE:
                path = self._path(ref, ref.where)
                return _entry(path, self._read(path), ref.key)
            case SecretKind.AGE:
                path = self._path(ref, ref.where)
                return _entry(path, self._decrypt(path, self._identity(ref)), ref.key)
            case _ as unreachable:
                assert_never(unreachable)

    def _path(self, ref: SecretRef, written: str) -> Path:
        if written.startswith("~/"):
            home = self.environ.get("HOME", "")
            if not home:
                raise _NoSecret("`~` needs the environment variable HOME")
            return Path(home) / written[2:]
        return (Path(ref.base) if ref.base else self.base) / written

    def _identity(self, ref: SecretRef) -> Path:
        if ref.identity:
            return self._path(ref, ref.identity)
        named = self.environ.get(IDENTITY_VARIABLE, "")
        if not named:
            raise _NoSecret("no identity for decryption", f"set `identity: PATH` or export {IDENTITY_VARIABLE}=PATH")
        return Path(named)

    def _read(self, path: Path) -> bytes:
        known = self._files.get((path, None))
        if known is None:
            known = self._files[path, None] = _read(path)
        return known

    def _decrypt(self, path: Path, identity: Path) -> bytes:
        known = self._files.get((path, identity))
        if known is None:
            # few inventories have encrypted files
            import pyrage

            try:
                known = pyrage.decrypt(_read(path), _identities(identity))
            except pyrage.DecryptError:
                raise _NoSecret(
                    f"{path} cannot be decrypted with {identity}",
                    "check that it is an age file and that this identity is one of its recipients",
                ) from None
            self._files[path, identity] = known
        return known


class _NoSecret(Exception):
    """Why a secret is unavailable; the message contains nothing of it."""

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint


def _read(path: Path) -> bytes:
    if found := special_file(path):
        raise _NoSecret(f"{path} is {found}")
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_SECRET_FILE_BYTES + 1)
    except (OSError, ValueError) as reason:
        why = reason.strerror if isinstance(reason, OSError) and reason.strerror else "not a path"
        raise _NoSecret(f"{path} cannot be read: {why}") from None
    if len(content) > MAX_SECRET_FILE_BYTES:
        raise _NoSecret(f"{path} is larger than {MAX_SECRET_FILE_BYTES} bytes")
    return content


def _identities(path: Path) -> list[pyrage.x25519.Identity | pyrage.ssh.Identity]:
    """An SSH private key, or the `AGE-SECRET-KEY-1...` lines of age-keygen."""
    import pyrage

    content = _read(path)
    try:
        if content.startswith(b"-----BEGIN"):
            return [pyrage.ssh.Identity.from_buffer(content)]
        lines = content.decode("ascii", errors="replace").splitlines()
        keys = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
        identities = [pyrage.x25519.Identity.from_str(key) for key in keys]
    except pyrage.IdentityError:
        raise _NoSecret(f"{path} contains no usable identity", "generate one with `age-keygen -o PATH`") from None
    if not identities:
        raise _NoSecret(f"{path} contains no identity", "generate one with `age-keygen -o PATH`")
    return identities


def _entry(path: Path, content: bytes, key: str) -> str:
    """One entry of a YAML mapping, or the whole file without its final newline."""
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        raise _NoSecret(f"{path} is not UTF-8 text") from None
    if not key:
        value = text.removesuffix("\n").removesuffix("\r")
        if not value:
            raise _NoSecret(f"{path} is empty")
        return value
    composed = compose(Source(str(path), text))
    if composed.diagnostics:
        # Only the position: the parser's message may quote the content.
        raise _NoSecret(f"{composed.diagnostics[0].position} is not valid YAML")
    if not isinstance(composed.root, MappingNode):
        raise _NoSecret(f"{path} is not a mapping, so it has no entry '{key}'")
    value_node = composed.root.values.get(key)
    if not isinstance(value_node, Scalar) or not value_node.text:
        raise _NoSecret(f"{path} has no entry '{key}' with text", did_you_mean(key, composed.root.values))
    return value_node.text
