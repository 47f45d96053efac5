"""What a daemon received from legacy robots is known to its next run."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.udp_mesh.core.test_legacy import fragments
from tests.udp_mesh.daemon.processes import RunningDaemon, configuration, poll, wait_online
from tests.udp_mesh.links.sockets import free_port
from udp_mesh.core.legacy.acks import ReceivePosition
from udp_mesh.daemon import legacy_positions
from udp_mesh.daemon.legacy_positions import LegacyPositions, load_positions, save_positions
from udp_mesh.wire.legacy import Host, LegacyAck, decode_legacy, encode_legacy

SOME = {"old": ReceivePosition(17, ((16, 2, 2), (17, 1, 9))), "older": ReceivePosition(1, ())}


def test_saved_positions_are_loaded_and_a_shorter_state_replaces_a_longer_one(tmp_path: Path) -> None:
    path = tmp_path / "state" / "positions.json"
    assert load_positions(path) == {}
    save_positions(path, SOME)
    assert load_positions(path) == SOME
    shorter = {"old": SOME["old"]}
    save_positions(path, shorter)
    assert load_positions(path) == shorter


@pytest.mark.parametrize(
    "text",
    ["", "[", "[1]", '{"old": 3}', '{"old": [0, []]}', '{"old": [1, [[1, 5, 2]]]}', '{"old": ["x", []]}', "[" * 9999],
)
def test_a_damaged_file_is_reported_and_ignored(text: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "positions.json"
    path.write_text(text)
    assert load_positions(path) == {}
    assert "legacy-positions-unreadable" in caplog.text


def test_saves_on_a_slow_disk_run_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, writing = tmp_path / "positions.json", threading.Lock()
    disk_asked, disk_answers = threading.Event(), threading.Event()

    def save_slowly(path: Path, positions: Mapping[str, ReceivePosition]) -> None:
        assert writing.acquire(blocking=False)
        disk_asked.set()
        assert disk_answers.wait(60)
        save_positions(path, positions)
        writing.release()

    async def save_twice() -> None:
        positions = LegacyPositions(path)
        first = asyncio.create_task(positions.save(SOME))
        await asyncio.to_thread(disk_asked.wait, 60)
        last = asyncio.create_task(positions.save({"old": SOME["old"]}))
        await asyncio.sleep(0)
        disk_answers.set()
        await asyncio.gather(first, last)
        assert not positions.is_saving

    monkeypatch.setattr(legacy_positions, "save_positions", save_slowly)
    asyncio.run(save_twice())
    assert load_positions(path) == {"old": SOME["old"]}


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_restarted_daemon_frees_the_slots_of_a_legacy_sender(how: signal.Signals) -> None:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path, socket.socket(type=socket.SOCK_DGRAM) as robot:
        folder, port = Path(path), free_port()
        robot.bind(("127.0.3.9", port))
        robot.settimeout(0.2)
        neighbour = '[[neighbours]]\naddress = "127.0.3.9"\nname = "old"\nlegacy = true\n'
        text = configuration(folder, "alice", 1, [], port).replace("[topics]", neighbour + "[topics]")
        daemon = RunningDaemon(folder, "alice", text)

        def tell(datagram: bytes) -> None:
            robot.sendto(datagram, ("127.0.3.1", port))

        def acknowledged() -> set[tuple[int, int]] | None:
            """The acknowledgments that answer a heartbeat."""
            tell(encode_legacy(Host("old", "127.0.3.9")))
            found = set()
            try:
                while True:
                    datagram = decode_legacy(robot.recv(2048))
                    if isinstance(datagram, LegacyAck):
                        found.add((datagram.sequence, datagram.position))
            except TimeoutError:
                return found or None

        saved = folder / "alice" / "legacy-positions.json"
        with daemon:
            tell(encode_legacy(Host("old", "127.0.3.9")))
            wait_online(daemon, "old")
            tell(encode_legacy(fragments(500, b"x")[0]))
            # the file is there, and empty, before it is written
            poll(lambda: saved.exists() and load_positions(saved).keys() == {"old"}, "the position is saved")
            assert json.loads(saved.read_text())["old"][0] == 500
            daemon.signal(how)
            assert daemon.process is not None
            daemon.process.wait()
            while acknowledged() is not None:
                pass
            daemon.start()
            assert {(501, 0), (502, 0), (503, 0)} <= poll(acknowledged, "acknowledgments")
