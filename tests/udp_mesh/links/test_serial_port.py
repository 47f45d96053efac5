"""Serial ports: frames through a pseudo-terminal, lines that take nothing, devices that go away, what is no port."""

from __future__ import annotations

import os
import pty
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.waiting import until
from udp_mesh.links.serial_port import BAUD_RATES, MAX_WAITING_BYTES, SerialPort, SerialPortConfig
from udp_mesh.wire.serial_framing import LineDecoder, encode_line


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """The other end, and the device."""
    master, slave = pty.openpty()
    device = os.ttyname(slave)
    os.close(slave)
    yield master, device
    with suppress(OSError):
        os.close(master)


def port(device: str) -> SerialPort:
    return SerialPort(SerialPortConfig("radio", device, 57_600))


def test_frames_pass_in_both_directions(line: tuple[int, str]) -> None:
    master, device = line
    opened = port(device)
    try:
        # Bytes that a terminal would change.
        frames = [bytes(range(256))[:255], b"\r\n\x03\x04\x11\x13", b"\x00"]
        for frame in frames:
            opened.send(frame)
        decoder = LineDecoder()
        found: list[bytes] = []
        while len(found) < 3:
            found += decoder.feed(os.read(master, 4096))
        assert found == frames
        os.write(master, b"noise\0" + encode_line(b"one") + encode_line(b"two")[:3])
        assert until(lambda: opened.receive() or None, "the first arrives") == [b"one"]
        os.write(master, encode_line(b"two")[3:])
        assert until(lambda: opened.receive() or None, "the second arrives") == [b"two"]
        assert opened.decoder.damaged == 1
    finally:
        opened.close()


def test_a_line_that_takes_nothing_loses_frames_and_holds_little(line: tuple[int, str]) -> None:
    _, device = line
    opened = port(device)
    try:
        for _ in range(2000):
            opened.send(bytes(200))
        assert opened.has_waiting
        assert len(opened._waiting) <= MAX_WAITING_BYTES
        assert opened.frames_lost > 0
    finally:
        opened.close()


def test_a_device_that_goes_away_is_an_error(line: tuple[int, str]) -> None:
    master, device = line
    opened = port(device)
    try:
        os.close(master)
        with pytest.raises(OSError):
            opened.receive()
    finally:
        opened.close()


def test_what_is_no_serial_port_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    before = len(os.listdir("/proc/self/fd"))
    for name, reason in (
        (tmp_path / "file", "not a serial port"),
        (tmp_path / "missing", "No such file"),
        (Path("/dev/null"), "not a serial port"),
    ):
        with pytest.raises(OSError, match=f"{reason}.*{name}"):
            port(str(name))
    assert len(os.listdir("/proc/self/fd")) == before


def test_usual_speeds_are_known() -> None:
    assert {9600, 38_400, 57_600, 115_200, 230_400, 921_600} <= set(BAUD_RATES)
