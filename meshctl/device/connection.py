"""The interface between meshctl and a node: endpoint, credentials, deadlines, connection, command result.

`meshctl.device.ssh.connect` makes a `Connection` from `Endpoint`, `Credentials` and `Deadlines`. The other modules
(`observe`, `upload`, `openwrt`, `deadman`) use a `Connection` and do not depend on SSH.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Protocol

from meshctl.device.errors import CommandFailed
from meshctl.model import Secret


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where a node answers. `interface` is the local interface to use, empty for the one of the routing table.

    `identity` is the name its host key is pinned under (`HostKeyAlias` in OpenSSH): the node's name in the inventory
    rather than its address, because factory devices all answer at 192.168.1.1 and a plan may change the address.
    """

    host: str
    port: int = 22
    user: str = "root"
    identity: str = ""
    interface: str = ""

    @property
    def address(self) -> str:
        """`host` or `[host]:port`, as known_hosts writes it."""
        return self.host if self.port == 22 else f"[{self.host}]:{self.port}"

    @property
    def pin_name(self) -> str:
        return self.identity or self.address

    @property
    def label(self) -> str:
        """For messages: `b03 (10.42.0.13 on eth1)`."""
        where = f"{self.address} on {self.interface}" if self.interface else self.address
        return f"{self.identity} ({where})" if self.identity else where


@dataclass(frozen=True, slots=True)
class Credentials:
    """Credentials, tried in this order: key files, the agent's keys, `password`.

    `empty_password` is only for first contact, because a factory device accepts root without a password: no
    authentication is tried first, an empty password last.
    """

    key_files: tuple[Path, ...] = ()
    use_agent: bool = True
    password: Secret | None = None
    empty_password: bool = False
    passphrase: Secret | None = None


@dataclass(frozen=True, slots=True)
class OwnKey:
    """The public part of a key we can log in with; `name` is its source (`key PATH`, `agent key COMMENT`)."""

    name: str
    key_type: str
    blob: bytes

    @property
    def base64(self) -> str:
        """As in authorized_keys."""
        return b64encode(self.blob).decode()

    @property
    def fingerprint(self) -> str:
        """`SHA256:...`, as `ssh-keygen -l` shows it."""
        return fingerprint_of(self.blob)


def fingerprint_of(blob: bytes) -> str:
    """`SHA256:...` of a public key's blob (RFC 4253 section 6.6): base64 without padding."""
    return "SHA256:" + b64encode(sha256(blob).digest()).decode().rstrip("=")


@dataclass(frozen=True, slots=True)
class Deadlines:
    """How long each phase may take, in seconds; then it ends with a `Timeout` of that `phase`.

    A radio with a 560 MHz MIPS core needs about two seconds for the key exchange when idle; a mesh of five hops that
    loses packets needs several times that.
    """

    connect_s: float = 10.0
    handshake_s: float = 30.0
    auth_s: float = 30.0
    channel_s: float = 15.0
    run_s: float = 60.0
    # Between commands. These keepalives want no reply, but TCP acknowledges them; the limit is four of them.
    keepalive_s: int = 15
    # While a command runs, the server is sent a keepalive every ask_s, and the connection is lost after silence_s. A
    # radio that hashes an image or erases flash still replies within a few seconds, and the data queued before the
    # keepalive takes six on the slowest link worth an upload (24 KiB of window at 4 KiB/s).
    ask_s: float = 5.0
    silence_s: float = 20.0


@dataclass(frozen=True, slots=True)
class Completed:
    """The result of one command. Text is decoded as UTF-8 with replacement: SSIDs and names may contain any byte."""

    stdout_bytes: bytes = field(repr=False)
    stderr_bytes: bytes = field(repr=False)
    exit_status: int

    @property
    def stdout(self) -> str:
        return self.stdout_bytes.decode("utf-8", "replace")

    @property
    def stderr(self) -> str:
        return self.stderr_bytes.decode("utf-8", "replace")

    def check(self, attempted: str) -> Completed:
        """Return self, or raise `CommandFailed` with the attempt, the exit status and the last line of stderr."""
        if self.exit_status == 0:
            return self
        words = (self.stderr.strip() or self.stdout.strip()).splitlines()
        last = f": {words[-1]}" if words else ""
        raise CommandFailed(
            f"{attempted}: exit status {self.exit_status}{last}", exit_status=self.exit_status, stderr=self.stderr
        )


class Connection(Protocol):
    """An authenticated session with one node. Not shared between threads; `close()` may come from any."""

    @property
    def endpoint(self) -> Endpoint: ...

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        """Run a POSIX shell script of any length on the node, with `stdin` as its standard input.

        `timeout_s` bounds the whole call (default `Deadlines.run_s`). Raises `Timeout`, `ConnectionLost`; an exit
        status other than zero is data, see `Completed.check`.
        """
        ...

    def close(self) -> None: ...


class KeepingConnection(Connection, Protocol):
    """A connection on which scripts are kept for further runs."""

    def run_kept(self, script: str, arguments: Sequence[str], *, timeout_s: float | None = None) -> Completed:
        """Run a script with these arguments, without input or standard error; a shell on the node keeps the script for
        the next time (`kept_script`).

        Deadline and errors as in `run`; ValueError for an argument with a line break.
        """
        ...
