"""Host key pinning: the fleet's file of pins, in OpenSSH's known_hosts format.

A `HostKeyPolicy` accepts a server's `HostKey` or raises. `TrustStore` is the file: a pinned key passes, an unknown one
is `HostKeyUnknown`, a different one `HostKeyChanged`. `AcceptAnyKey` accepts any. Names are those of the inventory, so
that `ssh -o UserKnownHostsFile=FILE -o HostKeyAlias=b03 root@10.42.0.13` trusts the same keys.
"""

from __future__ import annotations

import base64
import binascii
import fcntl
import hashlib
import hmac
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from meshctl.device.connection import Endpoint, fingerprint_of
from meshctl.device.errors import HostKeyChanged, HostKeyUnknown
from meshctl.device.file_state import FileState, file_state
from meshctl.errors import InputError


@dataclass(frozen=True, slots=True)
class HostKey:
    """A server's public key: its type (`ssh-ed25519`) and the blob that is base64 in known_hosts."""

    key_type: str
    blob: bytes

    @property
    def fingerprint(self) -> str:
        """`SHA256:...`, as `ssh-keygen -l` and newer dropbearkey show it (base64 without padding)."""
        return fingerprint_of(self.blob)

    @property
    def text(self) -> str:
        """`ssh-ed25519 AAAA...`, as in known_hosts and authorized_keys."""
        return f"{self.key_type} {base64.b64encode(self.blob).decode()}"


def parse_key(text: str) -> HostKey:
    """Parse `TYPE BASE64 [comment]`. Raises ValueError for anything else, or a blob of another type."""
    words = text.split()
    if len(words) < 2:
        raise ValueError(f"expected `TYPE BASE64`, found {text!r}")
    try:
        blob = base64.b64decode(words[1], validate=True)
    except binascii.Error as error:
        raise ValueError(f"expected base64 after {words[0]}: {error}") from error
    # RFC 4253 section 6.6: a blob starts with its type as a length-prefixed string
    length = int.from_bytes(blob[:4], "big")
    if len(blob) < 4 or blob[4 : 4 + length] != words[0].encode("ascii", "replace"):
        raise ValueError(f"the key's data is not of type {words[0]}")
    return HostKey(words[0], blob)


@dataclass(frozen=True, slots=True)
class Pin:
    """One line of the file: names, marker (`@revoked` or empty), key."""

    names: tuple[str, ...]
    key: HostKey
    marker: str = ""

    def covers(self, name: str) -> bool:
        return any(_is_hash_of(own, name) if own.startswith("|1|") else own == name for own in self.names)

    @property
    def line(self) -> str:
        return " ".join(filter(None, (self.marker, ",".join(self.names), self.key.text)))


def _is_hash_of(pattern: str, name: str) -> bool:
    """OpenSSH's HashKnownHosts: `|1|salt|HMAC-SHA1(salt, name)`, both in base64 (hostfile.c)."""
    try:
        salt, digest = (base64.b64decode(part, validate=True) for part in pattern.split("|")[2:])
    except (ValueError, binascii.Error):
        return False
    return hmac.compare_digest(hmac.new(salt, name.encode(), hashlib.sha1).digest(), digest)


def parse_pins(text: str, *, source: str = "known_hosts") -> tuple[Pin, ...]:
    """All pins of a known_hosts file. Raises InputError with the number of an invalid line.

    `@cert-authority` lines and patterns with `*`, `?` or `!` are invalid: a fleet's file names each node.
    """
    pins = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        marker = words.pop(0) if words[0].startswith("@") else ""
        try:
            if marker not in {"", "@revoked"}:
                raise ValueError(f"expected a plain or @revoked line, found {marker}")
            names = tuple(words[0].split(",")) if words else ()
            if any(set(name) & set("*?!") for name in names):
                raise ValueError(f"expected names without patterns, found {words[0]}")
            pins.append(Pin(names, parse_key(" ".join(words[1:3])), marker))
        except ValueError as error:
            raise InputError(f"{source}:{number}: {error}", hint="one line is `NAME TYPE BASE64`") from error
    return tuple(pins)


def dump_pins(pins: tuple[Pin, ...]) -> str:
    return "".join(f"{pin.line}\n" for pin in pins)


class HostKeyPolicy(Protocol):
    """Knows the keys of a node, so that the server is asked for one of their types, and checks its key."""

    def known(self, endpoint: Endpoint) -> tuple[HostKey, ...]: ...

    def check(self, endpoint: Endpoint, key: HostKey) -> None:
        """Return if the key is trusted; else raise HostKeyUnknown or HostKeyChanged."""
        ...


class _PinTable:
    """The pins of one state of the file, by name."""

    def __init__(self, pins: tuple[Pin, ...]) -> None:
        self.pins = pins
        self.revoked = frozenset(pin.key for pin in pins if pin.marker)
        # name -> line number and key; a hashed name can only be compared with each name looked up
        self._by_name: dict[str, list[tuple[int, HostKey]]] = {}
        self._hashed: list[tuple[int, Pin]] = []
        for number, pin in enumerate(pins):
            if pin.marker:
                continue
            if any(name.startswith("|1|") for name in pin.names):
                self._hashed.append((number, pin))
            else:
                for name in pin.names:
                    self._by_name.setdefault(name, []).append((number, pin.key))

    def keys(self, name: str) -> list[HostKey]:
        """The keys pinned for `name` and not marked, in the order of the file."""
        hashed = [(number, pin.key) for number, pin in self._hashed if pin.covers(name)]
        found = [*self._by_name.get(name, ()), *hashed]
        return [key for _, key in sorted(found, key=lambda entry: entry[0])]


class TrustStore:
    """The fleet's file of pins. `inventory` adds the keys pinned in the inventory (node name -> `TYPE BASE64` lines).

    Every read checks whether the file changed, and parses it only then: each connection reads it several times. A write
    locks the file, replaces it in one rename, and keeps all unrelated lines.
    """

    def __init__(self, path: Path, *, inventory: Mapping[str, tuple[str, ...]] | None = None) -> None:
        self.path = path
        self._inventory: dict[str, tuple[HostKey, ...]] = {}
        for name, lines in (inventory or {}).items():
            try:
                self._inventory[name] = tuple(parse_key(line) for line in lines)
            except ValueError as error:
                raise InputError(f"host key of {name}: {error}") from error
        # the file's state and its pins, replaced together: threads read them without a lock
        self._parsed: tuple[FileState, _PinTable] | None = None

    def pins(self) -> tuple[Pin, ...]:
        return self._table().pins

    def _table(self) -> _PinTable:
        try:
            # before it is read: a change in between makes the next read parse it again
            state = file_state(self.path)
            parsed = self._parsed
            if parsed is not None and parsed[0] == state:
                return parsed[1]
            text = self.path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return _PinTable(())
        except (OSError, UnicodeDecodeError) as error:
            reason = (error.strerror if isinstance(error, OSError) else "") or error
            hint = "`operators.known_hosts` names a text file with a line for each key"
            raise InputError(f"{self.path}: cannot read the pinned host keys: {reason}", hint=hint) from error
        table = _PinTable(parse_pins(text, source=str(self.path)))
        self._parsed = (state, table)
        return table

    def known(self, endpoint: Endpoint) -> tuple[HostKey, ...]:
        return self.pinned(endpoint.pin_name)

    def pinned(self, name: str) -> tuple[HostKey, ...]:
        """The trusted keys of `name`, those of the file first."""
        table = self._table()
        keys = [*table.keys(name), *self._inventory.get(name, ())]
        return tuple(key for key in dict.fromkeys(keys) if key not in table.revoked)

    def check(self, endpoint: Endpoint, key: HostKey) -> None:
        if key in self._table().revoked:
            raise HostKeyChanged(
                f"{endpoint.label}: has a revoked host key {key.fingerprint} ({key.key_type})",
                fingerprint=key.fingerprint,
                key_type=key.key_type,
            )
        pinned = self.pinned(endpoint.pin_name)
        if key in pinned:
            return
        if not pinned:
            raise HostKeyUnknown(
                f"{endpoint.label}: no host key is pinned; it has {key.fingerprint} ({key.key_type})",
                fingerprint=key.fingerprint,
                key_type=key.key_type,
                hint=f"compare it with the key on the node, then run `meshctl trust {endpoint.pin_name}`",
            )
        raise HostKeyChanged(
            f"{endpoint.label}: the host key changed: pinned {', '.join(pin.fingerprint for pin in pinned)}, "
            f"found {key.fingerprint} ({key.key_type})",
            fingerprint=key.fingerprint,
            key_type=key.key_type,
            pinned=tuple(pin.fingerprint for pin in pinned),
            hint="another device, a flash without meshctl, or an attack; "
            f"run `meshctl trust {endpoint.pin_name} --replace` once you know the reason",
        )

    def add(self, name: str, *keys: HostKey) -> None:
        """Pin further keys for `name`; those already pinned stay."""
        with self._rewriting() as pins:
            pins += [Pin((name,), key) for key in keys if not any(pin.covers(name) and pin.key == key for pin in pins)]

    def replace(self, name: str, *keys: HostKey) -> None:
        """Pin exactly these keys for `name`."""
        with self._rewriting() as pins:
            pins[:] = [*_without(pins, name), *(Pin((name,), key) for key in keys)]

    def forget(self, name: str) -> None:
        self.replace(name)

    @contextmanager
    def _rewriting(self) -> Iterator[list[Pin]]:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with (self.path.parent / f".{self.path.name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            pins = list(self.pins())
            yield pins
            with tempfile.NamedTemporaryFile("w", dir=self.path.parent, delete=False, encoding="utf-8") as new:
                new.write(dump_pins(tuple(pins)))
                new.flush()
                os.fsync(new.fileno())
            Path(new.name).replace(self.path)


def _without(pins: list[Pin], name: str) -> Iterator[Pin]:
    for pin in pins:
        if pin.marker or not pin.covers(name):
            yield pin
        elif others := tuple(other for other in pin.names if other != name and not other.startswith("|1|")):
            yield Pin(others, pin.key)


class AcceptAnyKey:
    """Accepts any host key and records it: on the bench the cable is the proof, and the key is pinned afterwards."""

    def __init__(self) -> None:
        self.key: HostKey | None = None

    def known(self, endpoint: Endpoint) -> tuple[HostKey, ...]:
        return ()

    def check(self, endpoint: Endpoint, key: HostKey) -> None:
        self.key = key
