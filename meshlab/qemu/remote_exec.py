"""Run a process in the machine with the host's descriptors: stdin, stdout and stderr are copied as frames.

Descriptors may be files, pipes or a terminal; they are read and written in threads, because an event loop cannot wait
for all of these.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import select
import termios
import tty
from collections.abc import Awaitable, Callable
from typing import Any

from meshlab.qemu import guest_protocol

Connect = Callable[..., Awaitable[tuple[asyncio.StreamReader, asyncio.StreamWriter]]]


async def run_process(connect: Connect, request: dict[str, Any], descriptors: list[int]) -> dict[str, Any]:
    """Run the process of `request`; returns the reply. Raises OSError when the machine ends."""
    source, out, err = descriptors
    size = _terminal_size(source)
    reader, writer = await connect("exec", request=request, terminal=size)
    loop = asyncio.get_running_loop()
    wake, wake_end = os.pipe()
    feeding = loop.run_in_executor(None, _stream_input, source, wake, loop, writer)
    try:
        while True:
            stream, length = guest_protocol.header(await reader.readexactly(guest_protocol.HEADER_BYTES))
            content = await reader.readexactly(length)
            if stream == guest_protocol.ANSWER:
                answer: dict[str, Any] = json.loads(content)
                return answer
            target = out if stream == guest_protocol.OUTPUT else err
            await loop.run_in_executor(None, _write_all, target, content)
    finally:
        os.close(wake_end)
        with contextlib.suppress(OSError):
            await feeding
        os.close(wake)
        writer.close()


def _terminal_size(descriptor: int) -> list[int] | None:
    """Rows and columns of a terminal, which is put in raw mode; None for anything else."""
    if not os.isatty(descriptor):
        return None
    tty.setraw(descriptor)
    rows, columns = termios.tcgetwinsize(descriptor)
    return [rows or 24, columns or 80]


def _stream_input(source: int, wake: int, loop: asyncio.AbstractEventLoop, writer: asyncio.StreamWriter) -> None:
    """Copy `source` into the machine until end of file or until the other end of `wake` is closed."""

    def send(content: bytes) -> None:
        if not writer.is_closing():
            writer.write(guest_protocol.frame(guest_protocol.INPUT, content))

    async def drain() -> None:
        with contextlib.suppress(OSError):
            await writer.drain()

    while True:
        ready, _, _ = select.select([source, wake], [], [])
        if wake in ready:
            return
        try:
            content = os.read(source, guest_protocol.FRAME_BYTES)
        except OSError:
            content = b""
        loop.call_soon_threadsafe(send, content)
        if not content:
            return
        asyncio.run_coroutine_threadsafe(drain(), loop).result()


def _write_all(target: int, content: bytes) -> None:
    # the client may have closed its end
    with contextlib.suppress(OSError):
        while content:
            content = content[os.write(target, content) :]
