"""The seam between meshctl and a robot's computer: run one of our scripts, put a file. `SshHost` is the real one.

An `SshHost` finds out once how it becomes root: it is root, or sudo asks nothing, or sudo wants a password, which goes
in on standard input before anything else and is never part of a command line.
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
    """A script on the robot would not go on; `code` is its reason's word (`no-space`, `busy`, `check`, ...)."""

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
        """What `scripts/VERB.sh`, called with `words`, prints. Raises Refused, CommandFailed and what SSH raises."""
        ...

    def put(self, content: bytes, path: str, mode: int = 0o644) -> int:
        """Make `path` hold `content`; gives the bytes that had to travel. A put that was cut goes on where it was."""
        ...


_HINTS = {
    "no-space": "make room at /opt, then deploy again",
    "busy": "wait until it is done, then run the command again",
    "moved": "look with `meshctl robots diff`, then run the command again",
    "not-installed": "`meshctl robots deploy` installs it",
    "service": "`meshctl robots logs` shows why",
    "masked": "ask who did, then `systemctl unmask` it there",
    "check": "the release is not installed; what runs there was not touched",
    "account": "look at /etc/passwd there, and whether its disk is writable",
    "no-release": "`meshctl robots deploy` brings what the inventory says",
    "damaged": "deploy again; if it happens again, look at the disk",
}


@dataclass(frozen=True, slots=True)
class SshHost(Host):
    """`connection` is logged in as any user who is root or may use sudo; see `become_root`. `owner` names us to the
    robot's lock, where we change something."""

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


# No greeting says this. What a computer's shell start-up files, sudo's lecture or its resolver say comes before it.
_OUTPUT_MARKER = "== meshctl begins"


class BannerFilter(Connection):
    """A connection whose scripts' output begins where they do: robots greet whoever logs in (~/.bashrc, sudo)."""

    def __init__(self, inner: Connection) -> None:
        self._inner = inner

    @property
    def endpoint(self) -> Endpoint:
        return self._inner.endpoint

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        said = quoted("echo", _OUTPUT_MARKER)
        done = self._inner.run(f"{said}; {said} >&2\n{script}", stdin=stdin, timeout_s=timeout_s)
        return replace(
            done, stdout_bytes=_without_banner(done.stdout_bytes), stderr_bytes=_without_banner(done.stderr_bytes)
        )

    def close(self) -> None:
        self._inner.close()


def _without_banner(said: bytes) -> bytes:
    """What comes after the line _BEGINS; all of it where the script never began, for then it tells why."""
    before, line, after = said.partition(f"{_OUTPUT_MARKER}\n".encode())
    return after if line else before


class SudoConnection(Connection):
    """A connection whose scripts run as root through sudo; `password` None where sudo asks for none."""

    def __init__(self, inner: Connection, password: Secret | None) -> None:
        self._inner = inner
        self._password = password

    @property
    def endpoint(self) -> Endpoint:
        return self._inner.endpoint

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        # -k: a cached login must not make sudo leave the password unread, for the script would take it as its input
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


# Tells how the login becomes root: `root`, `free` (sudo asks nothing), `password`, `no-sudo`, or `tty` (sudoers has
# requiretty).
_ROOT_PROBE = """\
if [ "$(id -u)" = 0 ]; then echo root
elif ! command -v sudo >/dev/null 2>&1; then echo no-sudo
elif why=$(LC_ALL=C sudo -k -n true 2>&1); then echo free
else case $why in *tty*) echo tty ;; *) echo password ;; esac; fi
"""


def become_root(connection: Connection, password: Callable[[], Secret | None]) -> Connection:
    """Scripts run by it run as root, through sudo if need be, and say nothing but what they say themselves.

    `password` is asked for only where sudo wants one; None means there is none to give. Raises CommandFailed where
    there is no way to become root.
    """
    label, user = connection.endpoint.label, connection.endpoint.user
    itself = BannerFilter(connection)
    if user == "root":
        return itself
    how = itself.run(_ROOT_PROBE).check(f"{label}: become root").stdout.strip()
    match how:
        case "root":
            return itself
        case "free":
            return BannerFilter(SudoConnection(connection, None))
        case "password":
            given = password()
            if given is None:
                hint = "give it with --ask-sudo or MESHCTL_SUDO_PASSWORD, or let sudo ask for none"
                raise CommandFailed(f"{label}: sudo wants a password for {user}", exit_status=1, hint=hint)
            elevated = BannerFilter(SudoConnection(connection, given))
            if elevated.run("id -u").stdout.strip() != "0":
                hint = "check the password, and that the user may use sudo"
                raise CommandFailed(f"{label}: sudo does not let {user} become root", exit_status=1, hint=hint)
            return elevated
        case "tty":
            hint = f"write `Defaults:{user} !requiretty` into a file in /etc/sudoers.d there"
            raise CommandFailed(f"{label}: sudo there works on a terminal only", exit_status=1, hint=hint)
        case _:
            hint = "log in as root, or install sudo there"
            raise CommandFailed(f"{label}: {user} is not root and there is no sudo", exit_status=1, hint=hint)
