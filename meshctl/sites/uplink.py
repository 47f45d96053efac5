"""The operator's connection to a site's worker: SSH to the gateway -> `meshctl worker --stdio` -> requests."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from meshctl import __version__
from meshctl.device.errors import CommandEnded, ConnectionLost
from meshctl.device.ssh_stream import LineStream
from meshctl.device.upload import upload
from meshctl.errors import InputError
from meshctl.model import Fleet, Site
from meshctl.nodes.connections import ConnectionPool
from meshctl.sites.gateway import WORKER_PROGRAM
from meshctl.sites.order import SignedOrder
from meshctl.sites.protocol import PROTOCOL, SILENCE_S, decode, encode, raise_error

_FINISH_S = 2.0
# Of a shell that cannot start a command (POSIX, Shell Command Language, 2.8.2).
_NOT_THERE = (126, 127)


@dataclass(frozen=True, slots=True)
class RemoteRun:
    """A run as its worker lists it; `state` as in `runs.RunState`."""

    run: str
    state: str
    operator: str
    command: str
    began_s: float


@dataclass(frozen=True, slots=True)
class Greeting:
    """What a worker says about itself: its version, the fingerprints of the keys that may sign, its runs."""

    version: str
    directory: str
    operators: tuple[str, ...]
    runs: tuple[RemoteRun, ...]

    def run(self, run: str) -> RemoteRun | None:
        return next((each for each in self.runs if each.run == run), None)


class Uplink:
    """One worker process at a site. Not shared between threads; `close` may come from any."""

    def __init__(self, fleet: Fleet, site: Site, access: ConnectionPool) -> None:
        """Connect and start the worker. Raises what `ssh.connect` raises, WorkerError and ConnectionLost."""
        self.site = site
        self._fleet = fleet
        self._connection = access.connect_gateway(site)
        try:
            self._stream = self._start()
            self.greeting = self._greet()
        except BaseException:
            self._connection.close()
            raise

    def _start(self) -> LineStream:
        return self._connection.stream(f"exec {WORKER_PROGRAM} --stdio {self._fleet.name}/{self.site.name}")

    def _greet(self) -> Greeting:
        try:
            said = self.ask({"do": "hello"})
        except CommandEnded as error:
            if error.exit_status in _NOT_THERE:
                raise InputError(
                    f"site {self.site.name}: meshctl is not installed on its gateway {self.site.ssh.host}",
                    hint=f"run `meshctl sites install {self.site.name}`",
                ) from error
            raise
        if said.get("protocol") != PROTOCOL or said.get("meshctl") != __version__:
            raise InputError(
                f"site {self.site.name}: its worker is meshctl {said.get('meshctl')}, here is {__version__}",
                hint=f"run `meshctl sites install {self.site.name}`",
            )
        return Greeting(
            str(said["meshctl"]),
            str(said["directory"]),
            tuple(map(str, said["operators"])),
            tuple(
                RemoteRun(
                    str(each["run"]),
                    str(each["state"]),
                    str(each["operator"]),
                    str(each["command"]),
                    float(each["began_s"]),
                )
                for each in said["runs"]
            ),
        )

    def ask(self, request: Mapping[str, object]) -> dict[str, Any]:
        """Send a request and wait for its reply for as long as the worker is alive. Raises WorkerError."""
        self._stream.send(encode(request), timeout_s=SILENCE_S)
        return self._reply()

    def _reply(self) -> dict[str, Any]:
        return self._reply_on(self._stream)

    def _reply_on(self, stream: LineStream) -> dict[str, Any]:
        while True:
            message = decode(stream.receive(timeout_s=SILENCE_S))
            raise_error(message, self.site.name)
            reply = message.get("reply")
            if isinstance(reply, dict):
                return reply

    def install(self, operators: Sequence[str]) -> str:
        """Let these public keys sign orders; returns the worker's own public key, which it makes if it has none."""
        return str(self.ask({"do": "install", "operators": list(operators)})["public_key"])

    def send_images(self, images: Mapping[str, Path]) -> None:
        """Upload the images (by SHA-256) that the gateway lacks, resuming an interrupted upload."""
        if images:
            missing = self.ask({"do": "images", "sha256": list(images)})["missing"]
            for sha256 in missing:
                upload(self._connection, images[sha256], f"{self.greeting.directory}/images/{sha256}")

    def plan(
        self,
        run: str,
        part: bytes,
        images: Mapping[str, str],
        nodes: Sequence[str],
        options: Sequence[str],
        agreed: str = "",
    ) -> tuple[str, dict[str, Any]]:
        """The plan that the worker made, or what still applies of the saved plan `agreed`, as JSON; and node -> what it
        would replace there. `images` are paths in the part with the SHA-256 of their content."""
        said = self.ask(
            {
                "do": "plan",
                "run": run,
                "part": base64.b64encode(part).decode(),
                "images": dict(images),
                "nodes": list(nodes),
                "options": list(options),
                "agreed": agreed,
            }
        )
        return str(said["plan"]), dict(said["replaced"])

    def status(self, run: str, part: bytes, nodes: Sequence[str], options: Sequence[str]) -> str:
        """The status of the site's nodes, as `meshctl status --json` prints it there."""
        encoded = base64.b64encode(part).decode()
        request = {"do": "status", "run": run, "part": encoded, "nodes": list(nodes), "options": list(options)}
        return str(self.ask(request)["status"])

    def start(self, order: SignedOrder) -> None:
        self.ask({"do": "start", "order": order.text, "key": order.key, "signature": order.signature})

    def has_forgotten(self, run: str) -> bool:
        """Whether the site started a run and has deleted what it knew of it."""
        return bool(self.ask({"do": "forgotten", "run": run})["forgotten"])

    def follow(self, run: str, offset: int) -> Iterator[dict[str, Any]]:
        """Replies with events of a run, from `offset` on; the last one has `over`."""
        self._stream.send(encode({"do": "follow", "run": run, "offset": offset}), timeout_s=SILENCE_S)
        while True:
            reply = self._reply()
            yield reply
            if "over" in reply:
                return

    def stop(self, run: str) -> bool:
        """Ask a run to stop, through a worker of its own: this one may be followed by another thread."""
        with self._start() as stream:
            stream.send(encode({"do": "stop", "run": run}), timeout_s=SILENCE_S)
            return bool(self._reply_on(stream)["stopping"])

    def close(self) -> None:
        """Close the connection, and let the worker delete what it planned and was not ordered."""
        if self._connection.is_open:
            with suppress(ConnectionLost):
                self._stream.send(encode({"do": "finish"}), timeout_s=_FINISH_S)
        self.abandon()

    def abandon(self) -> None:
        """Close the connection as if it were lost."""
        self._stream.close()
        self._connection.close()

    def __enter__(self) -> Uplink:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
