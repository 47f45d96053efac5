"""Debian's PostgreSQL: whether it is there, a server for the tests, and a connection to it that can be cut."""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from tests.meshctl.monitor.prometheus_program import free_tcp_port
from tests.waiting import until

NEEDS_POSTGRESQL = "MESHCTL_TESTS_NEED_POSTGRESQL"
WAIT_S = 60.0
_USER = "postgres"


def _programs() -> Path | None:
    """The directory of the newest server's programs, which Debian keeps out of PATH."""
    found = [path.parent for path in Path("/usr/lib/postgresql").glob("*/bin/initdb")]
    return max(found, key=lambda path: float(path.parent.name)) if found else None


def expects_postgresql() -> bool:
    """Whether its tests run: where it is installed, and where it must be."""
    return bool(os.environ.get(NEEDS_POSTGRESQL)) or _programs() is not None


class Server:
    """A server on loopback. It refuses to run as root: then it runs as the user of Debian's package."""

    def __init__(self, root: Path) -> None:
        programs = _programs()
        assert programs is not None, "there is no initdb: run scripts/setup-postgresql"
        self.port = free_tcp_port()
        self._programs, self._data = programs, root / "data"
        self._names = count(1)
        if os.getuid() == 0:
            shutil.chown(root, _USER)
        self._run(
            *("initdb", "--auth=trust", f"--username={_USER}", "--no-sync", "--encoding=UTF8", "--locale=C"),
            *("--pgdata", str(self._data)),
        )
        self._socket = root
        self.start()

    def start(self) -> None:
        settings = f"-p {self.port} -h 127.0.0.1 -k {self._socket} -F"
        self._run("pg_ctl", "start", "-w", "-D", str(self._data), "-l", str(self._data / "log"), "-o", settings)

    def stop(self, mode: str = "immediate") -> None:
        self._run("pg_ctl", "stop", "-w", "-m", mode, "-D", str(self._data))

    def _run(self, program: str, *arguments: str) -> None:
        become: dict[str, object] = {}
        if os.getuid() == 0:
            user = pwd.getpwnam(_USER)
            become = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}
        done = subprocess.run(
            [str(self._programs / program), *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            timeout=WAIT_S,
            check=False,
            cwd="/",
            **become,  # type: ignore[call-overload]
        )
        assert done.returncode == 0, done.stderr

    def new_database(self) -> str:
        """The URL of an empty database."""
        import psycopg

        name = f"fleet{next(self._names)}"
        with psycopg.connect(self.url("postgres"), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}".encode())
        return self.url(name)

    def url(self, database: str) -> str:
        return f"postgresql://{_USER}@127.0.0.1:{self.port}/{database}"


@contextmanager
def running() -> Iterator[Server]:
    root = Path(tempfile.mkdtemp(prefix="meshctl-postgresql-"))
    # the server's user has to reach it
    root.chmod(0o755)
    try:
        server = Server(root)
        try:
            yield server
        finally:
            server.stop()
    finally:
        shutil.rmtree(root)


class Uplink:
    """A TCP forwarder on loopback to a port, which can be cut, and can swallow everything without a word."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._is_cut = False
        self._is_silent = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            if self._is_cut:
                client.close()
                continue
            server = socket.create_connection(("127.0.0.1", self._target))
            self._pairs.append((client, server))
            threading.Thread(target=self._carry, args=(client, server), daemon=True).start()

    def _carry(self, client: socket.socket, server: socket.socket) -> None:
        with client, server:
            back = threading.Thread(target=self._copy, args=(server, client), daemon=True)
            back.start()
            self._copy(client, server)
            back.join()

    def _copy(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                until(lambda: not self._is_silent.is_set(), "the uplink to carry again", wait_s=WAIT_S)
                sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_RDWR)

    def cut(self) -> None:
        self._is_cut = True
        while self._pairs:
            for end in self._pairs.pop():
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    @contextmanager
    def silent(self) -> Iterator[None]:
        """Connections stay, and nothing comes through, as from a server that hangs."""
        self._is_silent.set()
        try:
            yield
        finally:
            self._is_silent.clear()

    def restore(self) -> None:
        self._is_cut = False

    def close(self) -> None:
        self.cut()
        self._listener.close()
