"""The machine's end of `guest_protocol`: requests, processes and forwarded ports."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import hmac
import json
import logging
import os
import pty
import struct
import termios
from collections.abc import Awaitable, Callable
from typing import Any

from meshlab.errors import LabError
from meshlab.qemu import guest_protocol
from meshlab.qemu.port_forwarder import QemuPortForwarder

log = logging.getLogger("meshlab.qemu.guest_agent")
_CHUNK_BYTES = 1 << 16
# a terminal passes on output with a delay
_TERMINAL_DRAIN_S = 0.05
_CLOSE_WAIT_S = 5.0


class GuestAgent:
    """Serves connections whose first line has `token`; `answer` handles the fleet's requests (`control.Answer`)."""

    def __init__(
        self,
        token: str,
        answer: Callable[[dict[str, Any], list[int]], Awaitable[dict[str, Any]]],
        port_forwarder: QemuPortForwarder,
    ) -> None:
        self._token = token
        self._answer = answer
        self._port_forwarder = port_forwarder
        self._server: asyncio.Server | None = None
        self._serving: set[asyncio.Task[None]] = set()

    async def open(self, host: str, port: int) -> None:
        self._server = await asyncio.start_server(self._accept, host, port, limit=guest_protocol.LINE_BYTES)

    def close(self) -> None:
        if self._server is not None:
            self._server.close()

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # keep a reference: the event loop holds tasks only weakly
        task = asyncio.ensure_future(self._serve(reader, writer))
        self._serving.add(task)
        task.add_done_callback(self._serving.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            first = json.loads(await reader.readline())
            if not hmac.compare_digest(str(first["token"]), self._token):
                return
            match first["kind"]:
                case "request":
                    writer.write(guest_protocol.line(await self._answer(first["request"], [])))
                    await writer.drain()
                case "exec":
                    await self._execute(first, reader, writer)
                case "dial":
                    await self._dial(first["host"], reader, writer)
                case "watch":
                    await self._watch(writer)
        except (OSError, ValueError, KeyError, TimeoutError, asyncio.IncompleteReadError) as error:
            log.info("connection-ended reason=%s", error)
        finally:
            writer.close()

    # -- forwarded ports --

    async def _watch(self, writer: asyncio.StreamWriter) -> None:
        while True:
            changed = self._port_forwarder.changed
            ports = {host: port.node for host, port in self._port_forwarder.reachable().items()}
            writer.write(guest_protocol.line({"doors": ports}))
            await writer.drain()
            await changed.wait()

    async def _dial(self, host: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._port_forwarder.is_hung(host):
            # accept, and send nothing until the client closes
            writer.write(guest_protocol.line({}))
            while await reader.read(_CHUNK_BYTES):
                pass
            return
        try:
            made = await self._port_forwarder.dial(host)
        except (OSError, LabError) as error:
            log.info("dial-failed host=%s reason=%s", host, error or type(error).__name__)
            writer.write(guest_protocol.line({"error": str(error) or type(error).__name__}))
            await writer.drain()
            return
        node_reader, node_writer = await asyncio.open_connection(sock=made)
        try:
            writer.write(guest_protocol.line({}))
            there = asyncio.ensure_future(_copy(reader, node_writer))
            back = asyncio.ensure_future(_copy(node_reader, writer))
            try:
                # after one direction ends, wait only a while for the other: a node without power never closes
                await asyncio.wait((there, back), return_when=asyncio.FIRST_COMPLETED)
                await asyncio.wait((there, back), timeout=_CLOSE_WAIT_S)
            finally:
                there.cancel()
                back.cancel()
                await asyncio.gather(there, back, return_exceptions=True)
        finally:
            node_writer.transport.abort()

    # -- processes --

    async def _execute(self, first: dict[str, Any], reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        streams = _Terminal(first["terminal"]) if first["terminal"] else _Pipes()
        loop = asyncio.get_running_loop()
        tasks = [asyncio.ensure_future(_stream_input(reader, streams))]
        ended = asyncio.Event()
        waiting = [
            loop.create_task(_stream_output(number, source, writer, ended)) for number, source in streams.outputs
        ]
        try:
            answer = await self._answer(first["request"], list(streams.theirs))
            streams.close_theirs()
            ended.set()
            await asyncio.wait(waiting, timeout=_TERMINAL_DRAIN_S if first["terminal"] else None)
            writer.write(guest_protocol.frame(guest_protocol.ANSWER, json.dumps(answer).encode()))
            await writer.drain()
        finally:
            for task in (*tasks, *waiting):
                task.cancel()
            await asyncio.gather(*tasks, *waiting, return_exceptions=True)
            streams.close()


class _Pipes:
    """Pipes for a process's stdin, stdout and stderr, and our ends of them. Every descriptor is closed once."""

    def __init__(self) -> None:
        read, self.input = os.pipe()
        out, out_end = os.pipe()
        err, err_end = os.pipe()
        self.theirs: tuple[int, ...] = (read, out_end, err_end)
        self.outputs: tuple[tuple[int, int], ...] = ((guest_protocol.OUTPUT, out), (guest_protocol.ERRORS, err))
        self._ours = {self.input, out, err}

    def end_input(self) -> None:
        """Close the process's stdin."""
        self._ours.discard(self.input)
        os.close(self.input)

    def close_theirs(self) -> None:
        descriptors, self.theirs = self.theirs, ()
        for descriptor in descriptors:
            os.close(descriptor)

    def close(self) -> None:
        self.close_theirs()
        while self._ours:
            os.close(self._ours.pop())


class _Terminal(_Pipes):
    """One terminal for all three streams, of the given rows and columns."""

    def __init__(self, size: list[int]) -> None:
        ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", size[0], size[1], 0, 0))
        self.input = ours
        self.theirs = (theirs, os.dup(theirs), os.dup(theirs))
        self.outputs = ((guest_protocol.OUTPUT, ours),)
        self._ours = {ours}

    def end_input(self) -> None:
        """A terminal's input ends with the process."""


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(_CHUNK_BYTES):
        writer.write(data)
        await writer.drain()
    with contextlib.suppress(OSError):
        writer.write_eof()


async def _stream_input(reader: asyncio.StreamReader, streams: _Pipes) -> None:
    """Write input frames to a process until an empty one closes its stdin."""
    loop = asyncio.get_running_loop()
    while True:
        _, length = guest_protocol.header(await reader.readexactly(guest_protocol.HEADER_BYTES))
        content = await reader.readexactly(length)
        if not content:
            streams.end_input()
            return
        # in a thread: writing to a full pipe blocks
        await loop.run_in_executor(None, _write_all, streams.input, content)


def _write_all(descriptor: int, content: bytes) -> None:
    with contextlib.suppress(BrokenPipeError):
        while content:
            content = content[os.write(descriptor, content) :]


async def _stream_output(number: int, descriptor: int, writer: asyncio.StreamWriter, ended: asyncio.Event) -> None:
    """Send a process's output as frames until it is closed. A background child may keep it open forever, so once the
    process has `ended`, at most one pipe buffer of the available output is read."""
    loop = asyncio.get_running_loop()
    os.set_blocking(descriptor, False)
    ready = asyncio.Event()
    loop.add_reader(descriptor, ready.set)
    waiting = asyncio.ensure_future(_set_with(ended, ready))
    left = _CHUNK_BYTES
    try:
        while left > 0:
            await ready.wait()
            # checked before reading: later output is not the ended process's
            has_ended = ended.is_set()
            try:
                content = os.read(descriptor, _CHUNK_BYTES)
            except BlockingIOError:
                if has_ended and not os.isatty(descriptor):
                    return
                ready.clear()
                continue
            except OSError:
                # EIO: the terminal's other end is closed
                return
            if not content:
                return
            if has_ended:
                left -= len(content)
            writer.write(guest_protocol.frame(number, content))
            await writer.drain()
    finally:
        waiting.cancel()
        loop.remove_reader(descriptor)


async def _set_with(cause: asyncio.Event, effect: asyncio.Event) -> None:
    await cause.wait()
    effect.set()
