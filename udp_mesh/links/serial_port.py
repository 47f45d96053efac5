"""A serial port that carries the frames of a thin link: 8 data bits, no parity, raw, without flow control (termios(3)).

Nothing here waits: `send` gives the kernel what it takes and keeps the rest for `write_more`. A device that is pulled
out raises OSError at the next use.
"""

from __future__ import annotations

import errno
import fcntl
import os
import termios
import tty
from dataclasses import dataclass

from udp_mesh.wire.framings import FRAMINGS, TRANSPARENT

READ_BYTES = 4096
MAX_WAITING_BYTES = 4096
"""Bytes that the kernel does not take are kept up to this; a device that takes nothing then loses frames."""


@dataclass(frozen=True, slots=True)
class SerialPortConfig:
    """One port: the thin link's name, the device, its speed in baud, and how frames are written to it."""

    link: str
    device: str
    baud: int
    framing: str = TRANSPARENT


BAUD_RATES = {int(name[1:]): getattr(termios, name) for name in dir(termios) if name[:1] == "B" and name[1:].isdigit()}
"""Speeds that the kernel knows by name; 0, which hangs up, is among them."""


class SerialPort:
    """An open port."""

    def __init__(self, config: SerialPortConfig) -> None:
        """Opens the device for this process alone. Raises OSError."""
        self.config = config
        framing = FRAMINGS[config.framing]
        self._encode, self.decoder = framing.encode, framing.decoder()
        self._waiting = bytearray()
        self.frames_lost = 0
        self._descriptor = os.open(config.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            self._configure(config.baud)
        except (termios.error, OSError) as error:
            os.close(self._descriptor)
            raise OSError(error.args[0], f"not a serial port: {error.args[1]}", config.device) from error

    def _configure(self, baud: int) -> None:
        fcntl.ioctl(self._descriptor, termios.TIOCEXCL)
        tty.setraw(self._descriptor, termios.TCSANOW)
        attributes = termios.tcgetattr(self._descriptor)
        attributes[2] = attributes[2] & ~(termios.CSTOPB | termios.CRTSCTS) | termios.CLOCAL | termios.CREAD
        attributes[4] = attributes[5] = BAUD_RATES[baud]
        termios.tcsetattr(self._descriptor, termios.TCSANOW, attributes)
        termios.tcflush(self._descriptor, termios.TCIOFLUSH)

    @property
    def ready(self) -> bool:
        """Whether frames can be sent: as soon as it is open."""
        return True

    @property
    def refusal(self) -> str | None:
        """Why the radio does not send what it gets."""
        return self.decoder.refusal

    def fileno(self) -> int:
        return self._descriptor

    def receive(self) -> list[bytes]:
        """The frames that have arrived completely. Raises OSError if the device is gone."""
        frames: list[bytes] = []
        while True:
            try:
                data = os.read(self._descriptor, READ_BYTES)
            except BlockingIOError:
                return frames
            if not data:
                raise OSError(errno.EIO, "the device is gone", self.config.device)
            frames += self.decoder.feed(data)

    def send(self, frame: bytes) -> None:
        """Send a frame, or lose it if too much waits. Raises OSError if the device is gone."""
        line = self._encode(frame)
        if len(self._waiting) + len(line) > MAX_WAITING_BYTES:
            self.frames_lost += 1
            return
        self._waiting += line
        self.write_more()

    @property
    def has_waiting(self) -> bool:
        """Whether `write_more` has something to do once the device takes more."""
        return bool(self._waiting)

    def write_more(self) -> None:
        """Continue with what waits. Raises OSError if the device is gone."""
        while self._waiting:
            try:
                del self._waiting[: os.write(self._descriptor, self._waiting)]
            except BlockingIOError:
                return

    def close(self) -> None:
        os.close(self._descriptor)
