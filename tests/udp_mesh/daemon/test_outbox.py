"""Messages on disk: stored messages are loaded again, however the process ended."""

import asyncio
import errno
import os
import signal
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.daemon.disks import standing_disk
from tests.udp_mesh.links.sockets import WAIT_S
from tests.waiting import until
from udp_mesh.core.interfaces import StoredMessage
from udp_mesh.daemon.outbox import DirectoryStore, Flusher


def message(key: int, payload: bytes = b"payload", remaining_s: float | None = None) -> StoredMessage:
    return StoredMessage(key, "base", "map/diff", "mesh_msgs/MapDiff", payload, remaining_s)


def test_remaining_messages_are_loaded_oldest_first(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path / "outbox", 1 << 20)
    for key in (3, 1, 2):
        store.put(message(key, bytes([key]) * 1000, remaining_s=key / 3))
    store.remove(2)
    store.remove(99)
    store.close()
    later = DirectoryStore(tmp_path / "outbox", 1 << 20)
    assert later.load() == [message(1, b"\x01" * 1000, 1 / 3), message(3, b"\x03" * 1000, 1.0)]
    assert later.bytes == store.bytes


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans(), st.binary(max_size=50)), max_size=12))
def test_the_store_matches_a_dictionary(steps: list[tuple[int, bool, bytes]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        store, expected = DirectoryStore(Path(folder), 1 << 20), dict[int, StoredMessage]()
        for key, put, payload in steps:
            if put:
                store.put(message(key, payload))
                expected[key] = message(key, payload)
            else:
                store.remove(key)
                expected.pop(key, None)
        store.close()
        again = DirectoryStore(Path(folder), 1 << 20)
        assert again.load() == [expected[key] for key in sorted(expected)]
        assert again.bytes == store.bytes


def test_a_full_directory_refuses_and_counts_messages(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path, 3000)
    for key in range(5):
        store.put(message(key, bytes(1000)))
    store.close()
    assert store.refused == 3
    assert len(store.load()) == 2


def test_a_damaged_file_is_set_aside_and_the_others_load(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path, 1 << 20)
    for key in (1, 2, 3):
        store.put(message(key))
    store.close()
    torn = tmp_path / f"{2:020d}.message"
    torn.write_bytes(torn.read_bytes()[:-1])
    (tmp_path / "half.new").write_bytes(b"half")
    assert [kept.key for kept in DirectoryStore(tmp_path, 1 << 20).load()] == [1, 3]
    assert torn.with_suffix(".damaged").exists()
    assert not (tmp_path / "half.new").exists()


def test_a_flush_skips_messages_delivered_in_the_meantime(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path, 1 << 20)
    store.put(message(1))
    store.put(message(2))
    store.remove(1)
    store.flush().result(WAIT_S)
    assert not store.needs_flush
    assert store.holds(2)
    assert not store.holds(1)
    store.close()
    assert [path.name for path in tmp_path.iterdir()] == [f"{2:020d}.message"]


def test_only_a_caller_of_flush_waits_for_a_hung_disk(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path, 1 << 20)
    with standing_disk(tmp_path, 1) as go_on:
        for key in (1, 2, 3):
            assert store.put(message(key))
        store.remove(2)
        asked = store.flush()
        assert not asked.done()
        assert store.bytes > 0
        assert not (tmp_path / f"{3:020d}.message").exists()
        go_on()
        asked.result(WAIT_S)
    assert not (tmp_path / f"{2:020d}.message").exists()
    assert (tmp_path / f"{3:020d}.message").exists()
    store.close()


def test_a_flush_is_not_reported_to_callers_before_it_is_complete(tmp_path: Path) -> None:
    async def run() -> None:
        store = DirectoryStore(tmp_path, 1 << 20)
        flusher = Flusher(store)
        with standing_disk(tmp_path, 1) as go_on:
            store.put(message(1))
            store.put(message(2))
            first, second = (asyncio.create_task(flusher.flush()) for _ in range(2))
            for _ in range(100):
                await asyncio.sleep(0)
            assert not store.needs_flush
            assert not first.done()
            assert not second.done()
            go_on()
            await asyncio.gather(first, second)
        store.close()

    asyncio.run(run())


def test_a_store_that_stays_full_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = DirectoryStore(tmp_path, 3000)
    for key in range(1000):
        store.put(message(key, bytes(1000)))
    store.close()
    assert store.refused == 998
    assert [record.getMessage().split()[0] for record in caplog.records] == ["outbox-full"]


def test_a_message_flushed_before_sigkill_is_loaded_after(tmp_path: Path) -> None:
    script = f"""
import os, signal
from pathlib import Path
from udp_mesh.core.interfaces import StoredMessage
from udp_mesh.daemon.outbox import DirectoryStore
store = DirectoryStore(Path({str(tmp_path)!r}), 1 << 20)
for key in range(20):
    store.put(StoredMessage(key, "base", "map", "", bytes(5000), None))
store.flush().result()
os.kill(os.getpid(), signal.SIGKILL)
"""
    ended = subprocess.run([sys.executable, "-c", script], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert [kept.key for kept in DirectoryStore(tmp_path, 1 << 20).load()] == list(range(20))


@given(st.data())
def test_any_corrupted_file_is_set_aside_and_the_others_load(
    data: st.DataObject,
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        store = DirectoryStore(Path(folder), 1 << 20)
        for key in (1, 2, 3):
            store.put(message(key, b"payload of some length", 12.5))
        store.close()
        victim = Path(folder) / f"{2:020d}.message"
        whole = victim.read_bytes()
        how = data.draw(st.sampled_from(["cut", "changed", "replaced", "zeros behind"]))
        if how == "cut":
            victim.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
        elif how == "changed":
            place, change = data.draw(st.integers(0, len(whole) - 1)), data.draw(st.integers(1, 255))
            victim.write_bytes(whole[:place] + bytes([whole[place] ^ change]) + whole[place + 1 :])
        elif how == "replaced":
            victim.write_bytes(data.draw(st.binary(max_size=200)))
        else:
            victim.write_bytes(whole + bytes(data.draw(st.integers(1, 100))))
        again = DirectoryStore(Path(folder), 1 << 20)
        loaded = again.load()
        # letters of the checksum may change their case
        assert [kept.key for kept in loaded if kept != message(2, b"payload of some length", 12.5)] == [1, 3]
        assert len(loaded) == 3 or victim.with_suffix(".damaged").exists()


def test_a_file_with_a_mismatched_name_is_set_aside(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path, 1 << 20)
    store.put(message(1))
    store.close()
    copy = tmp_path / f"{7:020d}.message"
    copy.write_bytes((tmp_path / f"{1:020d}.message").read_bytes())
    assert [kept.key for kept in DirectoryStore(tmp_path, 1 << 20).load()] == [1]
    assert copy.with_suffix(".damaged").exists()


def test_a_failed_write_is_counted_and_leaves_no_partial_file(tmp_path: Path) -> None:
    # a limit on files' sizes fails a write in its middle, as a full disk does
    script = f"""
import resource
from pathlib import Path
from udp_mesh.core.interfaces import StoredMessage
from udp_mesh.daemon.outbox import DirectoryStore
store = DirectoryStore(Path({str(tmp_path)!r}), 1 << 30)
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
for key, size in enumerate((5_000, 500_000, 6_000)):
    store.put(StoredMessage(key, "base", "map", "", bytes(size), None))
store.flush().result()
assert store.refused == 1, store.refused
assert [store.holds(key) for key in range(3)] == [True, False, True]
"""
    ended = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert "outbox-write-failed" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".message", ".message"]
    assert [kept.key for kept in DirectoryStore(tmp_path, 1 << 30).load()] == [0, 2]


@pytest.mark.parametrize("broken", ["files", "directory"])
def test_what_the_disk_does_not_confirm_is_not_on_disk(
    broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A failed fsync says that the data may be gone; a disk that fails is not logged for each message."""

    def fsync(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode) == (broken == "directory"):
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", fsync)
    store = DirectoryStore(tmp_path, 1 << 20)
    for key in range(5):
        store.put(message(key))
    store.flush().result(WAIT_S)
    assert not any(store.holds(key) for key in range(5))
    assert (store.refused, store.bytes) == (5, 0)
    store.close()
    assert not DirectoryStore(tmp_path, 1 << 20).load()
    assert [record.getMessage().split()[0] for record in caplog.records] == ["outbox-write-failed"]


def test_an_unusable_directory_is_reported_before_the_first_message(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "state").write_text("a file")
    for directory in (tmp_path / "state" / "outbox", tmp_path / "usable"):
        store = DirectoryStore(directory, 1 << 20)
        store.check_writable()
        store.close()
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith(f"outbox-unusable directory={tmp_path}/state/outbox error=")
    assert not list((tmp_path / "usable").iterdir())


def test_a_deleted_directory_is_reported_and_created_again(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path / "outbox", 1 << 20)
    store.put(message(1))
    path = tmp_path / "outbox" / f"{1:020d}.message"
    until(path.exists, "the message to be written", wait_s=WAIT_S)
    path.unlink()
    (tmp_path / "outbox").rmdir()
    store.flush().result(WAIT_S)
    store.put(message(2))
    store.close()
    assert [kept.key for kept in DirectoryStore(tmp_path / "outbox", 1 << 20).load()] == [2]


@pytest.mark.parametrize("closes", [False, True], ids=["while_it_runs", "when_it_closes"])
def test_a_file_that_could_not_be_removed_is_removed_later(
    closes: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A restart would send its message again. A directory in its place refuses like a read-only disk."""
    monkeypatch.setattr("udp_mesh.daemon.outbox.REMOVE_AGAIN_S", 1000.0 if closes else 0.05)
    store = DirectoryStore(tmp_path, 10_000)
    store.put(message(7))
    store.flush().result(WAIT_S)
    (file,) = tmp_path.glob("*.message")
    file.rename(tmp_path / "aside")
    file.mkdir()
    store.remove(7)
    store.flush().result(WAIT_S)
    file.rmdir()
    (tmp_path / "aside").rename(file)
    if closes:
        store.close()
    until(lambda: not file.exists(), "the file to be removed", wait_s=WAIT_S)
    if not closes:
        store.close()
    assert DirectoryStore(tmp_path, 10_000).load() == []


def test_a_node_that_starts_again_with_its_store_finds_each_message_once(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path, 1 << 20)
    for key in range(200):
        store.put(message(key))
    written_bytes = store.bytes
    for _ in range(2):
        # the writes may still be under way
        assert [kept.key for kept in store.load()] == list(range(200))
        assert store.bytes == written_bytes
    store.close()
