"""Commands of meshctl in processes of their own that need not import it again: a server imports it once, and forks.

A start imports for half a second of processor time, longer than most commands of the tests then take. A forked command
is a process like any other, with its own environment, streams, session and exit status; `tests/meshctl/cli` starts the
program itself, as do the tests that kill it.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from meshctl.cli.commands import COMMANDS
from meshctl.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
# far above what any command needs on a busy machine; a hang ends here
LIMIT_S = 600.0
_REQUEST_BYTES = 1 << 20


class ForkedCommand:
    """A running command; like `subprocess.Popen` without streams."""

    def __init__(self, answers: socket.socket) -> None:
        self._answers = answers
        self.pid = int(self._line())
        self._code: int | None = None

    def _line(self) -> str:
        text = b""
        while not text.endswith(b"\n"):
            more = self._answers.recv(64)
            if not more:
                raise EOFError("the server of forked commands has ended")
            text += more
        return text.decode()

    def poll(self) -> int | None:
        """The exit status, once there is one; negative for a signal."""
        return self._ended(0.0)

    def wait(self, timeout_s: float = LIMIT_S) -> int:
        """Raises TimeoutError."""
        code = self._ended(timeout_s)
        if code is None:
            raise TimeoutError(f"process {self.pid} still runs after {timeout_s:g} s")
        return code

    def _ended(self, timeout_s: float) -> int | None:
        if self._code is None and select.select([self._answers], [], [], timeout_s)[0]:
            self._code = int(self._line())
            self._answers.close()
        return self._code

    def send_signal(self, number: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def start(words: Sequence[str], environ: Mapping[str, str], out: IO[bytes], err: IO[bytes]) -> ForkedCommand:
    """Begin `meshctl WORDS` in the network namespace of this thread, with nothing to read."""
    ours, theirs = socket.socketpair()
    request = json.dumps([list(words), dict(environ), os.getcwd()]).encode()
    with theirs, _starting:
        socket.send_fds(_server().requests, [request], [theirs.fileno(), out.fileno(), err.fileno()])
    return ForkedCommand(ours)


@dataclass(frozen=True, slots=True)
class _Server:
    process: subprocess.Popen[bytes]
    requests: socket.socket

    def end(self) -> None:
        self.requests.close()
        self.process.wait()


# one for each network namespace, because a process is in that of its parent
_servers: dict[str, _Server] = {}
_starting = threading.Lock()


def _server() -> _Server:
    namespace = os.readlink("/proc/thread-self/ns/net")
    if namespace not in _servers:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, "-m", __name__, str(theirs.fileno())]
            process = subprocess.Popen(
                command, cwd=ROOT, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()], start_new_session=True
            )
        _servers[namespace] = _Server(process, ours)
        atexit.register(_servers[namespace].end)
    return _servers[namespace]


def serve(requests: socket.socket) -> None:
    """Fork for each request until the other side has ended. In a forked process, `main` ends it with SystemExit."""
    running: dict[int, socket.socket] = {}
    ended, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    while True:
        readable, _, _ = select.select([requests.fileno(), ended], [], [])
        if ended in readable:
            os.read(ended, 4096)
            _report_ended(running)
        if requests.fileno() not in readable:
            continue
        text, files, _, _ = socket.recv_fds(requests, _REQUEST_BYTES, 3)
        if not text:
            return
        answers, *streams = files
        words, environ, directory = json.loads(text)
        _import(words)
        pid = os.fork()
        if pid == 0:
            _become(environ, directory, *streams)
            sys.argv = ["meshctl", *words]
            main()
            sys.exit()
        for stream in streams:
            os.close(stream)
        running[pid] = socket.socket(fileno=answers)
        # the process that asked may be gone
        with contextlib.suppress(OSError):
            running[pid].send(f"{pid}\n".encode())


def _report_ended(running: dict[int, socket.socket]) -> None:
    while running:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if pid == 0:
            return
        with running.pop(pid) as answers, contextlib.suppress(OSError):
            answers.send(f"{os.waitstatus_to_exitcode(status)}\n".encode())


def _import(words: Sequence[str]) -> None:
    entry = COMMANDS.get(words[0]) if words else None
    if entry is not None and entry.module and entry.module not in sys.modules:
        importlib.import_module(entry.module)
        gc.collect()
        gc.freeze()


def _become(environ: Mapping[str, str], directory: str, out: int, err: int) -> None:
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setsid()
    os.dup2(out, 1)
    os.dup2(err, 2)
    # those of the server know whether its own streams could seek
    sys.stdin = open(0, closefd=False)  # noqa: SIM115
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115
    # of the server, and of other commands
    os.closerange(3, max(map(int, os.listdir("/proc/self/fd"))) + 1)
    os.chdir(directory)
    os.environ.clear()
    os.environ.update(environ)


if __name__ == "__main__":
    # paramiko imports it where it is; the program does without (`meshctl.cli.main`)
    sys.modules.setdefault("invoke", None)  # type: ignore[arg-type]
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    serve(socket.socket(fileno=int(sys.argv[1])))
