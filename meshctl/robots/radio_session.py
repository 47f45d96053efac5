"""One kept connection to a radio, through the system's `ssh`: a nonce in, its links out.

A robot's computer has no SSH library of meshctl's. The key that it logs in with may do nothing but run
`answering_script` on the radio (`authorized_keys` there); with another key the same script comes as the command.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import selectors
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from meshctl.device.link_table import LinkTable, answering_script, is_complete, parse_links
from meshctl.device.parse.sections import split_sections

CONNECT_TIMEOUT_S = 8.0
"""Small routers need seconds for a key exchange."""
ANSWER_TIMEOUT_S = 5.0
MAX_ANSWER_BYTES = 1 << 20
_CLOSE_S = 2.0


class RadioError(Exception):
    """The radio cannot be reached, or gave no answer; one line for people."""


@dataclass(frozen=True, slots=True)
class OwnRadio:
    """A radio of this robot, as its computer reaches it. Its host key is pinned under `name`."""

    name: str
    host: str
    port: int = 22
    user: str = "root"


@dataclass(frozen=True, slots=True)
class RadioLogin:
    """The private key, and a file of pinned host keys."""

    key: Path
    known_hosts: Path


def ssh_command(radio: OwnRadio, login: RadioLogin, program: str = "ssh") -> list[str]:
    """The system's `ssh` with nothing of the user's or the system's configuration."""
    options = {
        "BatchMode": "yes",
        "IdentitiesOnly": "yes",
        "IdentityAgent": "none",
        "IdentityFile": _path(login.key),
        "PreferredAuthentications": "publickey",
        "UserKnownHostsFile": _path(login.known_hosts),
        "GlobalKnownHostsFile": "/dev/null",
        "StrictHostKeyChecking": "yes",
        "HostKeyAlias": radio.name,
        "CheckHostIP": "no",
        "UpdateHostKeys": "no",
        "ClearAllForwardings": "yes",
        "ConnectTimeout": f"{CONNECT_TIMEOUT_S:.0f}",
        "ServerAliveInterval": "2",
        "ServerAliveCountMax": "3",
        "LogLevel": "ERROR",
    }
    words = [word for name, value in options.items() for word in ("-o", f"{name}={value}")]
    return [
        program,
        "-T",
        "-F",
        "none",
        *words,
        "-p",
        str(radio.port),
        "-l",
        radio.user,
        radio.host,
        answering_script(),
    ]


def _path(path: Path) -> str:
    # ssh_config(5): quotes keep spaces together, and % begins a token
    return f'"{str(path).replace("%", "%%")}"'


class RadioSession:
    """Asks one radio; connects when it is first asked, and again after an error. Not thread-safe."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None

    def ask(self) -> LinkTable:
        """The radio's links now, on the monotonic clock. Raises RadioError."""
        nonce = f"meshctl-{secrets.token_hex(8)}"
        is_new = self._process is None
        try:
            process = self._process = self._process or self._start()
            assert process.stdin is not None
            # a process that has ended says so when its answer is read
            with contextlib.suppress(BrokenPipeError):
                process.stdin.write(f"{nonce}\n".encode())
            timeout_s = ANSWER_TIMEOUT_S + (CONNECT_TIMEOUT_S if is_new else 0.0)
            output = self._answer(process, nonce, time.monotonic() + timeout_s)
        except OSError as error:
            self._end()
            raise RadioError(str(error.strerror or error)) from error
        except RadioError:
            self._end()
            raise
        return parse_links(split_sections(output, nonce), (), taken_s=time.monotonic())

    def close(self) -> None:
        self._end()

    def _start(self) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0
        )
        assert process.stderr is not None
        os.set_blocking(process.stderr.fileno(), False)
        return process

    def _answer(self, process: subprocess.Popen[bytes], nonce: str, deadline_s: float) -> bytes:
        assert process.stdout is not None
        output = bytearray()
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            while not is_complete(output, nonce):
                left_s = deadline_s - time.monotonic()
                if left_s <= 0 or not selector.select(left_s):
                    raise RadioError(self._reason("no answer"))
                part = os.read(process.stdout.fileno(), 65536)
                if not part:
                    # its last words may come after the end of its output
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(_CLOSE_S)
                    raise RadioError(self._reason("the connection ended"))
                output += part
                if len(output) > MAX_ANSWER_BYTES:
                    raise RadioError(f"its answer exceeds {MAX_ANSWER_BYTES >> 10} KiB")
        return bytes(output)

    def _reason(self, otherwise: str) -> str:
        """The last line of ssh's error output, or this text."""
        process = self._process
        error_output = process.stderr.read() if process is not None and process.stderr is not None else None
        lines = [line.strip() for line in (error_output or b"").decode("utf-8", "replace").splitlines()]
        return next((line for line in reversed(lines) if line), otherwise)

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        for stream in (process.stdin, process.stdout, process.stderr):
            if stream is not None:
                stream.close()
        process.terminate()
        try:
            process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
