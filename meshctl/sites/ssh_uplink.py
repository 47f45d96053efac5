"""The uplink to a gateway that the operator can log in to: SSH -> `meshctl worker --stdio` -> requests."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from meshctl.device.errors import CommandEnded, ConnectionLost
from meshctl.device.ssh_stream import LineStream
from meshctl.device.upload import upload
from meshctl.errors import InputError
from meshctl.model import Fleet, Site
from meshctl.nodes.connections import ConnectionPool
from meshctl.sites.gateway import WORKER_PROGRAM
from meshctl.sites.protocol import SILENCE_S, decode, encode, raise_error
from meshctl.sites.uplink import Greeting, Parcel, Uplink, greeting_of

_FINISH_S = 2.0
# Of a shell that cannot start a command (POSIX, Shell Command Language, 2.8.2).
_NOT_THERE = (126, 127)


class SshUplink(Uplink):
    """One worker process at a site, started by this uplink."""

    def __init__(self, fleet: Fleet, site: Site, access: ConnectionPool) -> None:
        """Connect and start the worker. Raises what `ssh.connect` raises, WorkerError and ConnectionLost."""
        self.site = site
        self._fleet = fleet
        self._connection = access.connect_gateway(site)
        try:
            self._stream = self._start()
            self._greeting = self._greet()
        except BaseException:
            self._connection.close()
            raise

    def _start(self) -> LineStream:
        return self._connection.stream(f"exec {WORKER_PROGRAM} --stdio {self._fleet.name}/{self.site.name}")

    def _greet(self) -> Greeting:
        try:
            return greeting_of(self.ask({"do": "hello"}), self.site.name)
        except CommandEnded as error:
            if error.exit_status in _NOT_THERE:
                raise InputError(
                    f"site {self.site.name}: meshctl is not installed on its gateway {self.site.ssh.host}",
                    hint=f"run `meshctl sites install {self.site.name}`",
                ) from error
            raise

    @property
    def greeting(self) -> Greeting:
        return self._greeting

    @property
    def accepted_keys(self) -> tuple[str, ...]:
        return self._greeting.operators

    def ask(self, request: Mapping[str, object]) -> dict[str, Any]:
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

    def send_images(self, images: Mapping[str, Path]) -> None:
        """An interrupted upload is resumed."""
        if images:
            missing = self.ask({"do": "images", "sha256": list(images)})["missing"]
            for sha256 in missing:
                upload(self._connection, images[sha256], f"{self.greeting.directory}/images/{sha256}")

    def start(self, parcel: Parcel) -> None:
        order = parcel.order
        self.ask({"do": "start", "order": order.text, "key": order.key, "signature": order.signature})

    def follow(self, run: str, offset: int) -> Iterator[dict[str, Any]]:
        self._stream.send(encode({"do": "follow", "run": run, "offset": offset}), timeout_s=SILENCE_S)
        while True:
            reply = self._reply()
            yield reply
            if "over" in reply:
                return

    def stop(self, run: str) -> bool:
        # through a worker of its own: this one may be followed by another thread
        with self._start() as stream:
            stream.send(encode({"do": "stop", "run": run}), timeout_s=SILENCE_S)
            return bool(self._reply_on(stream)["stopping"])

    def close(self) -> None:
        if self._connection.is_open:
            with suppress(ConnectionLost):
                self._stream.send(encode({"do": "finish"}), timeout_s=_FINISH_S)
        self._stream.close()
        self._connection.close()
