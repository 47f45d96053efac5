"""One command's SSH channel: standard input is sent while both outputs are collected, within limits."""

from __future__ import annotations

import select
import threading
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


def collect(channel: paramiko.Channel, label: str) -> tuple[bytes, bytes]:
    """Read stdout and stderr until both are closed and the exit status is known. Raises OutputTooLarge."""
    out, err = bytearray(), bytearray()
    poll = select.poll()
    poll.register(channel.fileno(), select.POLLIN)
    while True:
        ended = channel.exit_status_ready() and (channel.eof_received or channel.closed)
        while channel.recv_ready():
            out += channel.recv(_READ_BYTES)
        while channel.recv_stderr_ready():
            err += channel.recv_stderr(_READ_BYTES)
        if len(out) + len(err) > MAX_OUTPUT_BYTES:
            raise OutputTooLarge(
                f"{label}: the command printed more than {MAX_OUTPUT_BYTES >> 20} MiB and was ended",
                hint="print less (`| tail -n 100`), or use `meshctl ssh NODE -- COMMAND > FILE`",
            )
        if ended:
            return bytes(out), bytes(err)
        # the exit status has no file descriptor, so poll with a timeout
        poll.poll(_next_look_ms(channel))


def _next_look_ms(channel: paramiko.Channel) -> int:
    """The poll timeout: output and EOF wake it; after EOF only the exit status is missing."""
    if not channel.eof_received:
        return 500
    channel.status_event.wait(0.5)
    return 0
