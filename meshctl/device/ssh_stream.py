"""A long-lived command on a connection: lines in both directions, for as long as both sides want.

`SshConnection.stream` starts it. `send` writes a line; `receive` waits for the next one. A peer that is silent for too
long is `ConnectionLost`, and one that ends `CommandEnded`.
"""

from __future__ import annotations

from types import TracebackType

import paramiko

from meshctl.device.errors import CommandEnded, ConnectionLost, OutputTooLarge
from meshctl.device.ssh_channel import ignoring_closed

# A saved plan of a site with hundreds of nodes is a few MiB; a peer that sends more is not a worker.
MAX_LINE_BYTES = 64 << 20
_READ_BYTES = 64 << 10
_STATUS_S = 2.0


class LineStream:
    """One command's standard input and output as lines. `label` names the device in errors. Not thread-safe, but
    `close` may be called from any thread."""

    def __init__(self, channel: paramiko.Channel, label: str) -> None:
        self._channel = channel
        self._label = label
        self._buffer = bytearray()
        # up to here the buffer has no line break
        self._searched = 0

    def send(self, line: bytes, *, timeout_s: float) -> None:
        """Send a line, without its line break. Raises ConnectionLost."""
        self._channel.settimeout(timeout_s)
        try:
            self._channel.sendall(line + b"\n")
        except (paramiko.SSHException, OSError, EOFError) as error:
            raise ConnectionLost(f"{self._label}: the connection broke while sending: {error or 'timeout'}") from error

    def receive(self, *, timeout_s: float) -> bytes:
        """The next line, without its line break. Raises ConnectionLost at the end of the output or after `timeout_s`
        without any output, and OutputTooLarge."""
        self._channel.settimeout(timeout_s)
        while (end := self._buffer.find(b"\n", self._searched)) < 0:
            self._searched = len(self._buffer)
            if self._searched > MAX_LINE_BYTES:
                raise OutputTooLarge(f"{self._label}: a line of more than {MAX_LINE_BYTES >> 20} MiB")
            try:
                more = self._channel.recv(_READ_BYTES)
            except TimeoutError as error:
                raise ConnectionLost(f"{self._label}: silent for {timeout_s:g} s") from error
            except (paramiko.SSHException, OSError, EOFError) as error:
                raise ConnectionLost(f"{self._label}: the connection broke: {error}") from error
            if not more:
                raise CommandEnded(
                    f"{self._label}: {self._last_words() or 'the command ended'}", exit_status=self._exit_status()
                )
            self._buffer += more
        line = bytes(self._buffer[:end])
        del self._buffer[: end + 1]
        self._searched = 0
        return line

    def _last_words(self) -> str:
        """The last line of the error output, which says why a command ended."""
        text = b""
        with ignoring_closed():
            while self._channel.recv_stderr_ready():
                text += self._channel.recv_stderr(_READ_BYTES)
        lines = text.decode("utf-8", "replace").strip().splitlines()
        return lines[-1] if lines else ""

    def _exit_status(self) -> int | None:
        # it follows the end of the output, unless the server was killed
        self._channel.status_event.wait(_STATUS_S)
        return (
            self._channel.exit_status if self._channel.exit_status_ready() and self._channel.exit_status >= 0 else None
        )

    def close(self) -> None:
        with ignoring_closed():
            self._channel.close()

    def __enter__(self) -> LineStream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
