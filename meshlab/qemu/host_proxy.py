"""The process of a QEMU fleet on the host: it runs the machine and proxies requests and connections into it.

It starts as `python -m meshlab.qemu.host_proxy DIRECTORY` and reads the fleet from spec.json there:

    initramfs -> machine (retried once, with the reason in the log) -> a watch on the machine's forwarded ports
    control.sock: requests, and processes with their descriptors, like a virtual fleet's supervisor
    127.b.c.d, one port: a listening socket for each forwarded port, each connection dialed in the machine

It ends with the machine, or on `down`, and the machine ends with it.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import secrets
import signal
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from meshlab.control import Control
from meshlab.errors import LabError
from meshlab.listeners import Listeners, lock_port
from meshlab.qemu import guest_protocol, initramfs
from meshlab.qemu.qemu import TCG, Machine, cached_accelerator, find_qemu
from meshlab.qemu.remote_exec import run_process
from meshlab.shaped_tunnel import reset
from meshlab.spec import load

log = logging.getLogger("meshlab.qemu.host_proxy")
_CHUNK_BYTES = 1 << 16
_POLL_S = 0.5
# the time to boot until the supervisor is ready, under emulation on a busy host
_START_S = 180.0
_ATTEMPTS = 2
_ANSWER_S = 60.0


class HostProxy:
    """Proxies requests and connections to the machine until `stopping`."""

    def __init__(self, directory: Path, machine: Machine, token: str, port: int) -> None:
        self._directory = directory
        self._machine = machine
        self._token = token
        self._wanted_port = port
        self.port = 0
        self.stopping = asyncio.Event()
        self._listeners: Listeners[str] = Listeners(lambda host: host, self._serve)

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        for ending in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(ending, self.stopping.set)
        port_lock, self.port = lock_port(self._wanted_port)
        control = Control(self._directory, self.answer)
        control.open()
        watching = asyncio.ensure_future(self._watch())
        machine = os.pidfd_open(self._machine.pid)
        loop.add_reader(machine, self._machine_ended)
        try:
            await self.stopping.wait()
        finally:
            loop.remove_reader(machine)
            os.close(machine)
            control.close()
            watching.cancel()
            await asyncio.gather(watching, self._listeners.close(), return_exceptions=True)
            port_lock.close()

    def _machine_ended(self) -> None:
        log.error("machine-ended\n%s", self._machine.console_tail())
        self.stopping.set()

    # -- requests --

    async def answer(self, request: dict[str, Any], descriptors: list[int]) -> dict[str, Any]:
        """Forward one request of `control.sock` (`control.Answer`)."""
        if request["op"] == "down":
            self.stopping.set()
            return {}
        try:
            if descriptors:
                return await run_process(self._connect, request, descriptors)
            reader, writer = await self._connect("request", request=request)
            try:
                answer: dict[str, Any] = json.loads(await reader.readline())
            finally:
                writer.close()
        except (OSError, ValueError, asyncio.IncompleteReadError) as error:
            return {"error": f"the machine does not answer: {error}", "hint": f"see {self._machine.console}"}
        if request["op"] == "status" and "error" not in answer:
            answer |= {"pid": os.getpid(), "port": self.port}
        return answer

    async def _connect(self, kind: str, **fields: Any) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection("127.0.0.1", self._machine.port, limit=guest_protocol.LINE_BYTES)
        writer.write(guest_protocol.line({"token": self._token, "kind": kind, **fields}))
        await writer.drain()
        return reader, writer

    # -- forwarded ports --

    async def _watch(self) -> None:
        """Keep the listening sockets in sync with the machine's reachable ports."""
        while True:
            with contextlib.suppress(OSError, ValueError):
                reader, writer = await self._connect("watch")
                try:
                    while line := await reader.readline():
                        self._listeners.update(json.loads(line)["doors"].keys(), self.port)
                finally:
                    writer.close()
            await asyncio.sleep(_POLL_S)

    async def _serve(self, host: str, client: socket.socket) -> None:
        try:
            reader, writer = await self._connect("dial", host=host)
            try:
                answer = json.loads(await reader.readline())
                if "error" in answer:
                    log.info("dial-failed host=%s reason=%s", host, answer["error"])
                    raise ConnectionResetError(answer["error"])
                await asyncio.gather(_to_machine(client, writer), _from_machine(reader, client))
            finally:
                writer.close()
        except (OSError, ValueError):
            reset(client)
        finally:
            client.close()


async def _to_machine(client: socket.socket, writer: asyncio.StreamWriter) -> None:
    loop = asyncio.get_running_loop()
    while data := await loop.sock_recv(client, _CHUNK_BYTES):
        writer.write(data)
        await writer.drain()
    writer.write_eof()


async def _from_machine(reader: asyncio.StreamReader, client: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    while data := await reader.read(_CHUNK_BYTES):
        await loop.sock_sendall(client, data)
    with contextlib.suppress(OSError):
        client.shutdown(socket.SHUT_WR)


def start(directory: Path, spec_text: str, token: str) -> Machine:
    """Start the fleet's machine. Raises LabError after two failed attempts, whose consoles are kept."""
    find_qemu()
    cache = initramfs.cache_folder()
    base = initramfs.base_image(cache)
    initrd = initramfs.build_initrd(base, spec_text, token, directory)
    spec = load(spec_text)
    radios = sum(len(node.radios) for node in spec.nodes)
    accelerator = cached_accelerator(base.kernel, cache)
    log.info("accelerator options=%s", " ".join(accelerator.options))
    machine = Machine(directory, base.kernel, initrd, radios=radios, nodes=len(spec.nodes))
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            machine.start(accelerator, _START_S)
            _check_reachable(machine, token)
            break
        except LabError as error:
            machine.stop()
            log.error("start-failed attempt=%d reason=%s\n%s", attempt, error, error.hint)
            kept = machine.console.rename(directory / f"console.failed-{attempt}") if machine.console.exists() else None
            if attempt == _ATTEMPTS:
                raise LabError(f"{error} ({_ATTEMPTS} times); consoles are kept: {kept}", hint=error.hint) from error
            # KVM may fail in a long boot though the short probe succeeded
            accelerator = TCG
    initrd.unlink()
    return machine


def _check_reachable(machine: Machine, token: str) -> None:
    """Check that a machine that reports ready also answers. Raises LabError when it does not."""
    try:
        with socket.create_connection(("127.0.0.1", machine.port), timeout=_ANSWER_S) as connection:
            connection.sendall(guest_protocol.line({"token": token, "kind": "request", "request": {"op": "status"}}))
            if connection.recv(1):
                return
            reason = "it closed the connection"
    except OSError as error:
        reason = str(error)
    raise LabError(f"the machine is ready but does not answer: {reason}", hint=machine.console_tail())


def main(arguments: Sequence[str]) -> int:
    """Run the fleet in DIRECTORY. Errors are written to `failure` there, as for a virtual fleet."""
    directory = Path(arguments[1]).resolve()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s")
    spec_text = (directory / "spec.json").read_text(encoding="utf-8")
    token = secrets.token_hex(16)
    try:
        machine = start(directory, spec_text, token)
        try:
            (directory / "supervisor.pid").write_text(f"{os.getpid()}\n", encoding="ascii")
            asyncio.run(HostProxy(directory, machine, token, load(spec_text).port).run())
        finally:
            machine.stop()
    except (LabError, OSError) as error:
        (directory / "failure").write_text(f"{error}\n{getattr(error, 'hint', '')}\n", encoding="utf-8")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
