"""The interface to a robot's computer: run a script, upload a file. `SshHost` implements it over SSH.

`become_root` finds out once how to get root: logged in as root, passwordless sudo, or sudo with a password, which is
sent on standard input and never part of a command line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Protocol

from meshctl.device.connection import Completed, Connection, Endpoint
from meshctl.device.errors import CommandFailed
from meshctl.device.framing import quoted
from meshctl.device.upload import upload
from meshctl.errors import NodeError
from meshctl.model import Secret
from meshctl.robots.scripts import script


class ScriptRefused(NodeError):
    """A script on the robot refused to continue; `code` is the reason (`no-space`, `busy`, `check`, ...)."""

    def __init__(self, message: str, *, code: str, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.code = code


class Host(Protocol):
    """A robot's computer, as root."""

    @property
    def label(self) -> str:
        """For messages: `husky1 (10.42.0.10)`."""
        ...

    def run(self, verb: str, *words: str, stdin: bytes = b"", timeout_s: float) -> str:
        """Output of `scripts/VERB.sh` with arguments `words`. Raises ScriptRefused, CommandFailed and SSH errors."""
        ...

    def put(self, content: bytes, path: str, mode: int = 0o644) -> int:
        """Upload `content` to `path`, resuming an interrupted upload; returns the bytes sent."""
        ...


_HINTS = {
    "no-space": "free disk space in /opt, then deploy again",
    "busy": "wait until it is done, then run the command again",
    "moved": "run `meshctl robots diff`, then the command again",
    "not-installed": "run `meshctl robots deploy`",
    "service": "run `meshctl robots logs` for the reason",
    "masked": "find out why, then run `systemctl unmask` there",
    "check": "the release was not installed; the running one was not touched",
    "account": "check /etc/passwd there, and that its disk is writable",
    "no-release": "run `meshctl robots deploy`",
    "damaged": "deploy again; if it recurs, check the disk",
}


@dataclass(frozen=True, slots=True)
class SshHost(Host):
    """`connection` runs scripts as root (see `become_root`); `owner` is our name in the robot's lock."""

    connection: Connection
    owner: str = ""

    @property
    def label(self) -> str:
        return self.connection.endpoint.label

    def run(self, verb: str, *words: str, stdin: bytes = b"", timeout_s: float) -> str:
        program = f"owner={quoted(self.owner)}\n{script(verb)}"
        command = quoted("sh", "-c", program, f"udp-mesh-{verb}", *words)
        done = self.connection.run(command, stdin=stdin, timeout_s=timeout_s)
        last = (done.stderr.strip().splitlines() or [""])[-1]
        if last.startswith("refused "):
            _, code, reason = f"{last} ".split(" ", 2)
            raise ScriptRefused(f"{self.label}: {reason.strip() or code}", code=code, hint=_HINTS.get(code, ""))
        return done.check(f"{self.label}: {verb}").stdout

    def put(self, content: bytes, path: str, mode: int = 0o644) -> int:
        return upload(self.connection, content, path, mode=mode).sent


# Everything before this line is a banner: shell start-up files, sudo's lecture, resolver warnings.
_OUTPUT_MARKER = "== meshctl begins"


class BannerFilter(Connection):
    """Drops login banners (~/.bashrc, sudo) from the output of scripts."""

    def __init__(self, inner: Connection) -> None:
        self._inner = inner

    @property
    def endpoint(self) -> Endpoint:
        return self._inner.endpoint

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        print_marker = quoted("echo", _OUTPUT_MARKER)
        done = self._inner.run(f"{print_marker}; {print_marker} >&2\n{script}", stdin=stdin, timeout_s=timeout_s)
        return replace(
            done, stdout_bytes=_without_banner(done.stdout_bytes), stderr_bytes=_without_banner(done.stderr_bytes)
        )

    def close(self) -> None:
        self._inner.close()


def _without_banner(output: bytes) -> bytes:
    """The output after the marker line; all of it if the script did not start, since that is the error."""
    before, line, after = output.partition(f"{_OUTPUT_MARKER}\n".encode())
    return after if line else before


class SudoConnection(Connection):
    """Runs scripts as root with sudo; `password` is None for passwordless sudo."""

    def __init__(self, inner: Connection, password: Secret | None) -> None:
        self._inner = inner
        self._password = password

    @property
    def endpoint(self) -> Endpoint:
        return self._inner.endpoint

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        # -k: with cached credentials sudo would leave the password unread, as input of the script
        how = ("-n",) if self._password is None else ("-k", "-S", "-p", "")
        command = quoted("sudo", *how, "--", "sh", "-c", script)
        if self._password is not None:
            first = f"{self._password.reveal()}\n".encode()
            stdin = first + stdin if isinstance(stdin, bytes) else _chained(first, stdin)
        return self._inner.run(command, stdin=stdin, timeout_s=timeout_s)

    def close(self) -> None:
        self._inner.close()


def _chained(first: bytes, rest: Iterable[bytes]) -> Iterable[bytes]:
    yield first
    yield from rest


# Prints how to become root: `root`, `free` (passwordless sudo), `password`, `no-sudo`, or `tty` (requiretty).
_ROOT_PROBE = """\
if [ "$(id -u)" = 0 ]; then echo root
elif ! command -v sudo >/dev/null 2>&1; then echo no-sudo
elif why=$(LC_ALL=C sudo -k -n true 2>&1); then echo free
else case $why in *tty*) echo tty ;; *) echo password ;; esac; fi
"""


def become_root(connection: Connection, password: Callable[[], Secret | None]) -> Connection:
    """A connection that runs scripts as root, with sudo if necessary, and drops banners from their output.

    `password` is called only if sudo requires one; None means that there is none. Raises CommandFailed if root is not
    available.
    """
    label, user = connection.endpoint.label, connection.endpoint.user
    plain = BannerFilter(connection)
    if user == "root":
        return plain
    how = plain.run(_ROOT_PROBE).check(f"{label}: become root").stdout.strip()
    match how:
        case "root":
            return plain
        case "free":
            return BannerFilter(SudoConnection(connection, None))
        case "password":
            given = password()
            if given is None:
                hint = "pass --ask-sudo or set MESHCTL_SUDO_PASSWORD, or configure passwordless sudo"
                raise CommandFailed(f"{label}: sudo requires a password for {user}", exit_status=1, hint=hint)
            elevated = BannerFilter(SudoConnection(connection, given))
            if elevated.run("id -u").stdout.strip() != "0":
                hint = "check the password and the user's sudo rights"
                raise CommandFailed(f"{label}: sudo does not let {user} become root", exit_status=1, hint=hint)
            return elevated
        case "tty":
            hint = f"add `Defaults:{user} !requiretty` to a file in /etc/sudoers.d there"
            raise CommandFailed(f"{label}: sudo requires a terminal (requiretty)", exit_status=1, hint=hint)
        case _:
            hint = "log in as root, or install sudo there"
            raise CommandFailed(f"{label}: {user} is not root and there is no sudo", exit_status=1, hint=hint)
