"""One command's SSH channel: standard input is sent while both outputs are collected, within limits."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import paramiko

from meshctl.device.errors import (
    OutputTooLarge,
    UploadFailed,
)

# The output limit of a command: more than any observation, but bounded for 200 nodes in parallel.
MAX_OUTPUT_BYTES = 16 << 20

# Up to this much stdin fits the receive window of every dropbear (24 KiB) and needs no thread.
MAX_INLINE_STDIN_BYTES = 8 << 10

# How long output beyond the limit is discarded: a command that ends by itself leaves nothing behind on the node.
DISCARD_S = 2.0

OPEN_ATTEMPTS = 5

_READ_BYTES = 32 << 10


@contextmanager
def ignoring_closed() -> Iterator[None]:
    """Closing what is already closed is no error."""
    try:
        yield
    except (paramiko.SSHException, OSError, EOFError):
        return


class _Feeder(threading.Thread):
    """Writes stdin while the main thread reads; `failure` is the exception of the data source, if any."""

    def __init__(self, channel: paramiko.Channel, pieces: Iterable[bytes]) -> None:
        super().__init__(daemon=True)
        self.failure: Exception | None = None
        self._channel = channel
        self._pieces = pieces

    def run(self) -> None:
        source = iter(self._pieces)
        while True:
            try:
                piece = next(source)
            except StopIteration:
                break
            except OSError as error:
                self.failure = UploadFailed(f"cannot read the data to upload: {error}")
                break
            try:
                self._channel.sendall(piece)
            except (paramiko.SSHException, OSError, EOFError):
                # The command ended without reading all of it, which its exit status shows, or the link was cut, which
                # the reader detects.
                return
        with ignoring_closed():
            self._channel.shutdown_write()


@contextmanager
def sending_stdin(
    channel: paramiko.Channel, preamble: bytes, pieces: Iterable[bytes], *, inline: bool
) -> Iterator[_Feeder | None]:
    """Send `preamble` and `pieces` to the command: at once if they fit its window, else from a thread."""
    if inline:
        text = preamble + b"".join(pieces)
        if len(text) <= MAX_INLINE_STDIN_BYTES:
            with ignoring_closed():
                channel.sendall(text)
                channel.shutdown_write()
            yield None
            return
        pieces = (text[at : at + _READ_BYTES] for at in range(0, len(text), _READ_BYTES))
        preamble = b""
    feeder = _Feeder(channel, _chained(preamble, pieces))
    feeder.start()
    try:
        yield feeder
    finally:
        with ignoring_closed():
            channel.shutdown_write()
        feeder.join(timeout=5.0)


def _chained(first: bytes, rest: Iterable[bytes]) -> Iterator[bytes]:
    if first:
        yield first
    yield from rest


class _Activity(threading.Event):
    """Set by both of a channel's buffers when something comes; only the reader clears it.

    paramiko's own way, a pipe behind `Channel.fileno`, breaks the whole connection when a channel is closed while
    output still comes: its thread then writes to the closed pipe.
    """

    def clear(self) -> None:
        """Ignore the buffer that has been read to its end: the other one may not have been."""

    def rearm(self) -> None:
        super().clear()


def open_session(transport: paramiko.Transport) -> paramiko.Channel:
    """A session channel.

    Dropbear before 2024.86 closes a channel in which no command has been started yet when the process of an earlier
    channel ends. Nothing has been executed then, so the channel is opened again.
    """
    for _ in range(OPEN_ATTEMPTS - 1):
        try:
            channel = transport.open_session()
        except paramiko.ChannelException:
            raise
        except paramiko.SSHException:
            if not transport.is_active():
                raise
        else:
            if not channel.closed:
                return channel
    return transport.open_session()


def collect(channel: paramiko.Channel, label: str) -> tuple[bytes, bytes]:
    """Read stdout and stderr until both are closed and the exit status is known. Raises OutputTooLarge."""
    out, err = bytearray(), bytearray()
    activity = _Activity()
    channel.in_buffer.set_event(activity)
    channel.in_stderr_buffer.set_event(activity)
    discard_until = math.inf
    while True:
        activity.rearm()
        ended = channel.exit_status_ready() and (channel.eof_received or channel.closed)
        while channel.recv_ready() and len(out) <= MAX_OUTPUT_BYTES:
            out += channel.recv(_READ_BYTES)
        while channel.recv_stderr_ready() and len(err) <= MAX_OUTPUT_BYTES:
            err += channel.recv_stderr(_READ_BYTES)
        if len(out) + len(err) > MAX_OUTPUT_BYTES:
            out.clear()
            err.clear()
            discard_until = min(discard_until, time.monotonic() + DISCARD_S)
        if discard_until < math.inf and (ended or time.monotonic() > discard_until):
            raise OutputTooLarge(
                f"{label}: the command printed more than {MAX_OUTPUT_BYTES >> 20} MiB and was ended",
                hint="print less (`| tail -n 100`), or use `meshctl ssh NODE -- COMMAND > FILE`",
            )
        if ended:
            return bytes(out), bytes(err)
        # output and EOF set `activity`; after EOF only the exit status is missing
        (channel.status_event if channel.eof_received else activity).wait(0.5)
