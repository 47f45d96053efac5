"""Uploads over a real dropbear: whole, resumed, damaged on the way, too large, paced."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import cast

import paramiko
import pytest

from meshctl.device.connection import Completed, Connection, Endpoint
from meshctl.device.errors import ChannelClosed, ConnectionLost, UploadFailed
from meshctl.device.ssh import SshConnection
from meshctl.device.ssh_channel import _Feeder
from meshctl.device.upload import CHUNK_BYTES, UploadProgress, upload
from meshctl.errors import InputError
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import Server, dropbear, log_in, ready

TARGET = "/tmp/firmware/image.bin"


def leftovers(node: Sandbox) -> list[str]:
    return sorted(path.name for path in node.path(TARGET).parent.glob(".*"))


@pytest.mark.parametrize("size", [0, 1, CHUNK_BYTES - 1, CHUNK_BYTES, 3 * CHUNK_BYTES + 17])
def test_content_is_uploaded_intact_with_its_mode(connection: SshConnection, node: Sandbox, size: int) -> None:
    data = os.urandom(size)
    reported: list[UploadProgress] = []
    done = upload(connection, data, TARGET, mode=0o600, progress=reported.append)
    assert node.path(TARGET).read_bytes() == data
    assert node.path(TARGET).stat().st_mode & 0o777 == 0o600
    assert (done.sha256, done.sent, done.kept) == (hashlib.sha256(data).hexdigest(), size, 0)
    assert [step.verified for step in reported] == sorted({0, *(step.verified for step in reported)})
    assert reported[-1] == UploadProgress(size, size)
    assert leftovers(node) == []


def test_a_file_is_read_from_disk_and_a_second_upload_sends_nothing(
    connection: SshConnection, node: Sandbox, tmp_path: Path
) -> None:
    source = tmp_path / "image"
    source.write_bytes(os.urandom(CHUNK_BYTES + 5))
    assert upload(connection, source, TARGET).sent == CHUNK_BYTES + 5
    again = upload(connection, source, TARGET)
    assert (again.sent, again.kept) == (0, CHUNK_BYTES + 5)
    with pytest.raises(InputError, match="no-such-image"):
        upload(connection, tmp_path / "no-such-image", TARGET)


class CutAfter(Connection):
    """A connection whose server is killed once `chunks` chunks have been confirmed, in the middle of the next."""

    def __init__(self, connection: SshConnection, server: Server, chunks: int) -> None:
        self._connection = connection
        self._server = server
        self._left = chunks

    @property
    def endpoint(self) -> Endpoint:
        return self._connection.endpoint

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        data = stdin if isinstance(stdin, bytes) else b"".join(stdin)
        if data and self._left == 0:
            return self._connection.run(script, stdin=self._half(data), timeout_s=timeout_s)
        self._left -= 1 if data else 0
        return self._connection.run(script, stdin=data, timeout_s=timeout_s)

    def _half(self, data: bytes) -> Iterator[bytes]:
        yield data[: len(data) // 2]
        self._server.stop()
        yield data[len(data) // 2 :]

    def close(self) -> None:
        self._connection.close()


def test_an_interrupted_upload_resumes_from_the_verified_data(node: Sandbox, tmp_path: Path) -> None:
    ready(node, tmp_path)
    data = os.urandom(5 * CHUNK_BYTES + 99)
    for chunks in (2, 1, 0):
        with dropbear(node) as server, log_in(server, node, tmp_path) as connected:
            cutting = CutAfter(connected, server, chunks)
            with pytest.raises((ConnectionLost, ChannelClosed)):
                upload(cutting, data, TARGET)
        assert not node.path(TARGET).exists()
    with dropbear(node) as server, log_in(server, node, tmp_path) as connected:
        done = upload(connected, data, TARGET)
    assert node.path(TARGET).read_bytes() == data
    # the chunk under way at a cut may have arrived whole, so more than what was verified may be kept, never less
    assert done.kept >= 3 * CHUNK_BYTES
    assert done.kept + done.sent == len(data)
    assert leftovers(node) == []


def test_a_damaged_part_is_found_by_its_hash_and_sent_again(connection: SshConnection, node: Sandbox) -> None:
    data = os.urandom(3 * CHUNK_BYTES)
    name = f".image.bin.{hashlib.sha256(data).hexdigest()[:16]}.part"
    rotten = bytearray(data)
    rotten[CHUNK_BYTES + 7] ^= 1
    node.put(f"/tmp/firmware/{name}", bytes(rotten))
    done = upload(connection, data, TARGET)
    assert node.path(TARGET).read_bytes() == data
    assert (done.kept, done.sent) == (CHUNK_BYTES, 2 * CHUNK_BYTES)


def test_parts_of_other_contents_are_neither_used_nor_left_behind(connection: SshConnection, node: Sandbox) -> None:
    node.put("/tmp/firmware/.image.bin.0123456789abcdef.part", b"x" * CHUNK_BYTES)
    upload(connection, b"small", TARGET)
    assert node.path(TARGET).read_bytes() == b"small"
    assert leftovers(node) == []


def test_a_partial_file_longer_than_the_content_is_cut_to_it(connection: SshConnection, node: Sandbox) -> None:
    data = os.urandom(CHUNK_BYTES)
    name = f".image.bin.{hashlib.sha256(data).hexdigest()[:16]}.part"
    node.put(f"/tmp/firmware/{name}", data + b"left by a writer of a cut connection")
    upload(connection, data, TARGET)
    assert node.path(TARGET).read_bytes() == data


class Spoiling(Connection):
    """A connection that changes a byte of every chunk."""

    def __init__(self, connection: SshConnection, times: int) -> None:
        self._connection = connection
        self._times = times

    @property
    def endpoint(self) -> Endpoint:
        return self._connection.endpoint

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        data = bytearray(stdin if isinstance(stdin, bytes) else b"".join(stdin))
        if data and self._times:
            self._times -= 1
            data[0] ^= 1
        return self._connection.run(script, stdin=bytes(data), timeout_s=timeout_s)

    def close(self) -> None:
        self._connection.close()


def test_data_corrupted_in_transit_is_detected_and_never_installed(connection: SshConnection, node: Sandbox) -> None:
    data = os.urandom(2 * CHUNK_BYTES)
    upload(Spoiling(connection, 1), data, TARGET)
    assert node.path(TARGET).read_bytes() == data
    node.path(TARGET).unlink()
    with pytest.raises(UploadFailed, match="the data was corrupted"):
        upload(Spoiling(connection, 1000), data, TARGET)
    assert not node.path(TARGET).exists()


def test_content_larger_than_free_space_is_rejected_before_sending(node: Sandbox, tmp_path: Path) -> None:
    ready(node, tmp_path)
    reported: list[UploadProgress] = []
    with dropbear(node, tmp_kib=1024) as server, log_in(server, node, tmp_path) as connected:
        with pytest.raises(UploadFailed, match=r"needs 2049 KiB, 10[0-9][0-9] KiB are free"):
            upload(connected, os.urandom(2 << 20), TARGET, progress=reported.append)
        upload(connected, os.urandom(700 << 10), TARGET)
        assert connected.run(f"wc -c <{TARGET}").stdout == f"{700 << 10}\n"
    assert reported == []


def test_the_rate_limit_is_kept_by_pausing_after_sent_data(connection: SshConnection, node: Sandbox) -> None:
    pauses: list[float] = []
    data = os.urandom(CHUNK_BYTES + 1000)
    upload(connection, data, TARGET, rate_bytes_per_s=50_000, sleep=pauses.append)
    assert node.path(TARGET).read_bytes() == data
    assert sum(pauses) == pytest.approx(len(data) / 50_000)
    assert max(pauses) <= 0.1


def test_an_invalid_target_path_raises_value_error(connection: SshConnection) -> None:
    for path in ("relative", "/", "/tmp/.."):
        with pytest.raises(ValueError, match="absolute path"):
            upload(connection, b"x", path)


def test_an_eof_while_sending_stdin_only_stops_the_feeder() -> None:
    """paramiko says so with an EOFError of its own, at whatever moment of a write the link goes."""

    class Gone:
        def sendall(self, piece: bytes) -> None:
            raise EOFError

        def shutdown_write(self) -> None:
            raise EOFError

    feeder = _Feeder(cast(paramiko.Channel, Gone()), iter((b"first", b"second")))
    feeder.run()
    assert feeder.failure is None
