"""A history keeps what was appended through a kill and a full disk, and stays within its age and size."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from meshctl.errors import InputError, MeshctlError
from meshctl.monitor.alarm_log import Silence
from meshctl.monitor.frame import Frame
from meshctl.monitor.store import MIN_BYTES, FrameStore
from tests.meshctl.monitor.documents import frame
from tests.processes import killed_on_failure

ROOT = Path(__file__).resolve().parents[3]
DAY_S = 86400.0


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "history.sqlite"


@pytest.fixture
def store(path: Path) -> Iterator[FrameStore]:
    with FrameStore.open(path, DAY_S, 64 << 20) as opened:
        yield opened


def noise(size: int, seed: int) -> str:
    """Text that does not compress well."""
    return random.Random(seed).randbytes(size // 2).hex()


def times(frames: Iterator[Frame] | tuple[Frame, ...]) -> list[float]:
    return [one.time_s for one in frames]


def test_a_frame_is_found_by_its_time(store: FrameStore) -> None:
    assert (store.latest(), store.at(1e12), store.span(), store.timeline(0, 10, 2)[0].frames) == (None, None, None, 0)
    kept = [frame(1000.0 + index / 4) for index in range(9)]
    for one in kept:
        store.append(one)
    assert (store.problem, store.latest(), store.at(1001.3), store.at(999.0)) == ("", kept[-1], kept[5], None)
    assert store.span() == (1000.0, 1002.0)
    assert times(store.after(1001.5)) == [1001.75, 1002.0]
    assert times(store.between(1000.25, 1001.0, 10)) == [1000.25, 1000.5, 1000.75, 1001.0]
    assert times(store.between(0, 2000, 3)) == [1000.0, 1001.0, 1002.0]
    assert times(store.between(0, 2000, 1)) == [1002.0]
    with pytest.raises(ValueError, match="not newer"):
        store.append(frame(1002.0))


def test_many_frames_are_read_in_batches_while_more_are_appended(store: FrameStore) -> None:
    for index in range(70):
        store.append(frame(float(index + 1)))
    reader = store.after(0)
    first = next(reader)
    store.append(frame(71.0))
    assert [first.time_s, *times(reader)] == [float(index + 1) for index in range(71)]


def test_the_timeline_has_the_worst_of_each_bucket(store: FrameStore) -> None:
    store.append(frame(100.0, {("b01", "weak"): "warning"}))
    store.append(frame(101.0, {("b01", "alone"): "error", ("b02", "weak"): "warning"}, go=False))
    store.append(frame(115.0, go=None))
    store.append(frame(125.0, {("", "robots-unasked"): "note"}))
    found = [(b.start_s, b.frames, b.go, b.errors, b.warnings, b.notes) for b in store.timeline(100, 140, 4)]
    assert found == [
        (100.0, 2, False, 1, 1, 0),
        (110.0, 1, None, 0, 0, 0),
        (120.0, 1, True, 0, 0, 1),
        (130.0, 0, None, 0, 0, 0),
    ]


def test_frames_and_alarms_beyond_the_age_are_removed(path: Path) -> None:
    with FrameStore.open(path, 100.0, MIN_BYTES) as store:
        store.append(frame(1000.0, {("b01", "weak"): "warning"}))
        store.append(frame(1010.0))
        store.append(frame(1105.0))
        assert store.span() == (1010.0, 1105.0)
        assert [one.code for one in store.alarms(active_only=False, now_s=1105.0)] == ["weak"]
        store.append(frame(1211.0))
        assert (store.span(), store.alarms(active_only=False, now_s=1211.0)) == ((1211.0, 1211.0), ())


def test_the_files_stay_within_their_size_and_shrink_with_it(path: Path) -> None:
    def on_disk() -> int:
        return sum(file.stat().st_size for file in path.parent.iterdir())

    with FrameStore.open(path, DAY_S, 3 * MIN_BYTES) as store:
        for index in range(120):
            store.append(frame(float(index + 1), padding=noise(400_000, index)))
            assert on_disk() <= 3 * MIN_BYTES + (1 << 20)
        (first, last), everything = store.span() or (0.0, 0.0), 120 * 200_000
        assert last == 120.0
        assert everything > 3 * MIN_BYTES / 2, "the test fills the file"
        assert 1.0 < first < 100.0, "the oldest went, and no more than necessary"
    with FrameStore.open(path, DAY_S, MIN_BYTES) as store:
        for index in range(120, 160):
            store.append(frame(float(index + 1)))
        assert store.latest() == frame(160.0)
    assert on_disk() <= MIN_BYTES + (1 << 20), "the limit was lowered"


def test_a_killed_process_loses_no_appended_frame(path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from meshctl.monitor.store import FrameStore\n"
        "from tests.meshctl.monitor.documents import frame\n"
        "store = FrameStore.open(Path(sys.argv[1]), 86400.0, 64 << 20); store.claim()\n"
        "for index in range(100_000):\n"
        "    store.append(frame(float(index + 1), {('b01', f'code{index // 7}'): 'error'}, padding='x' * 30000))\n"
        "    print(index + 1, store.problem, flush=True)\n"
    )
    seen = 0
    for _ in range(3):
        with subprocess.Popen(
            [sys.executable, "-c", script.replace("range(100_000)", f"range({seen}, 100_000)"), str(path)],
            stdout=subprocess.PIPE, cwd=ROOT, text=True,
        ) as writer, killed_on_failure(writer):  # fmt: skip
            assert writer.stdout is not None
            for line in writer.stdout:
                assert line.split() == [str(seen + 1)]
                seen += 1
                if seen % 40 == 0:
                    break
            os.kill(writer.pid, signal.SIGKILL)
            # lines that were in the pipe when it died are of frames that were appended
            seen += len(writer.stdout.readlines())
        with FrameStore.open(path, DAY_S, 64 << 20) as store:
            found = times(store.after(0))
            assert found[:seen] == [float(index + 1) for index in range(seen)]
            assert len(found) <= seen + 1, "at most the frame that was being appended is there, too"
            assert len(store.alarms(now_s=1e6)) == 1
            seen = len(found)
            store.claim()
        with closing(sqlite3.connect(path)) as database:
            assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)


ON_FULL_DISK = """
import os, sys
from pathlib import Path
from meshctl.monitor.store import FrameStore
from tests.meshctl.monitor.documents import frame
from tests.meshctl.monitor.test_store import noise
disk = Path(sys.argv[1])
path, ballast = disk / "history.sqlite", disk / "ballast"
ballast.write_bytes(bytes(2 << 20))
store = FrameStore.open(path, 86400.0, 64 << 20)
when, kept, alarm = 0.0, [], {("b01", "alone"): "error"}
while not store.problem:
    when += 1
    began = store.append(frame(when, {}, padding=noise(100_000, int(when))))
    kept += [] if store.problem else [when]
assert "disk is full" in store.problem and "free space" in store.problem, store.problem
assert store.latest().time_s == when and store.at(when).time_s == when
assert [one.time_s for one in store.after(kept[-1])] == [when]
began = store.append(frame(when + 1, alarm, padding=noise(100_000, 1)))
assert [one.code for one in began] == ["alone"], "hooks get them on a full disk, too"
assert store.problem and store.alarms(now_s=when) == ()
ballast.unlink()
assert store.append(frame(when + 2, alarm)) == ()
assert store.problem == "", store.problem
(logged,) = store.alarms(now_s=when)
assert (logged.first_s, logged.last_s) == (when + 1, when + 2)
store.close()
with FrameStore.open(path, 86400.0, 64 << 20) as store:
    assert [one.time_s for one in store.after(0)] == [*kept, when + 2]
    assert store._file.read("PRAGMA integrity_check", ()) == [("ok",)]
print("survived", len(kept))
"""


def test_a_full_disk_costs_the_frames_of_that_time_alone(tmp_path: Path) -> None:
    mount = f'mount -t tmpfs -o size=6m tmpfs {tmp_path} && exec {sys.executable} -c "$0" {tmp_path}'
    done = subprocess.run(
        ["unshare", "--map-root-user", "--mount", "sh", "-c", mount, ON_FULL_DISK],
        capture_output=True, text=True, cwd=ROOT, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[1]) > 10


def test_other_threads_and_processes_read_while_frames_are_appended(path: Path) -> None:
    with FrameStore.open(path, DAY_S, 64 << 20) as store, FrameStore.open(path, DAY_S, 64 << 20) as other:
        wrong: list[str] = []
        done = threading.Event()

        def read(which: FrameStore) -> None:
            last = 0.0
            while not done.is_set():
                for one in which.after(last):
                    if one.time_s != last + 1:
                        wrong.append(f"{one.time_s} after {last}")
                    last = one.time_s
            if last < 90:
                wrong.append(f"read up to {last}")

        threads = [threading.Thread(target=read, args=(each,)) for each in (store, other)]
        for thread in threads:
            thread.start()
        for index in range(100):
            store.append(frame(float(index + 1)))
        # both have a last look
        other.alarms(now_s=0)
        threading.Event().wait(0.05)
        done.set()
        for thread in threads:
            thread.join(10)
        assert wrong == []


def test_one_process_appends(path: Path) -> None:
    with FrameStore.open(path, DAY_S, MIN_BYTES) as one, FrameStore.open(path, DAY_S, MIN_BYTES) as other:
        one.claim()
        with pytest.raises(InputError, match="another meshctl monitor"):
            other.claim()
    with FrameStore.open(path, DAY_S, MIN_BYTES) as later:
        later.claim()


def test_a_recording_is_read_where_nothing_can_be_written(path: Path) -> None:
    with FrameStore.open(path, DAY_S, MIN_BYTES) as store:
        store.append(frame(1.0))
    before = path.read_bytes()
    mount = (
        f"mount --bind {path.parent} {path.parent} && mount -o remount,ro,bind {path.parent}"
        f" && exec {sys.executable} -c 'import sys, pathlib; from meshctl.monitor.store import FrameStore;"
        " print(FrameStore.open_recording(pathlib.Path(sys.argv[1])).span())'"
        f" {path}"
    )
    done = subprocess.run(
        ["unshare", "--map-root-user", "--mount", "sh", "-c", mount],
        capture_output=True, text=True, cwd=ROOT, timeout=60, check=False,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("(1.0, 1.0)\n", "")
    with FrameStore.open_recording(path) as recording:
        assert recording.latest() == frame(1.0)
    assert path.read_bytes() == before


def test_wrong_files_are_named(tmp_path: Path) -> None:
    foreign = tmp_path / "notes.txt"
    foreign.write_text("not a database, but long enough for SQLite to look at its header\n" * 4)
    newer = tmp_path / "newer.sqlite"
    with sqlite3.connect(newer) as database:
        database.execute("PRAGMA user_version = 9")
    database.close()
    with pytest.raises(InputError, match="nosuch: no such file"):
        FrameStore.open_recording(tmp_path / "nosuch")
    with pytest.raises(MeshctlError, match=r"notes\.txt: cannot read as a history"):
        FrameStore.open_recording(foreign)
    with pytest.raises(MeshctlError, match=r"notes\.txt: not a history of meshctl"):
        FrameStore.open(foreign, DAY_S, MIN_BYTES)
    with pytest.raises(MeshctlError, match=r"version 9, expected 1"):
        FrameStore.open_recording(newer)
    with pytest.raises(MeshctlError, match=r"history of version 9, expected 1"):
        FrameStore.open(newer, DAY_S, MIN_BYTES)
    with pytest.raises(ValueError, match="at least"):
        FrameStore.open(newer, DAY_S, 1000)


@pytest.mark.parametrize("version", [0, 1])
def test_a_database_of_another_program_is_left_as_it_is(tmp_path: Path, version: int) -> None:
    foreign = tmp_path / "photos.sqlite"
    with sqlite3.connect(foreign) as database:
        database.execute("CREATE TABLE photos (name TEXT)")
        database.execute(f"PRAGMA user_version = {version}")
    database.close()
    before = foreign.read_bytes()
    with pytest.raises(MeshctlError, match=r"photos\.sqlite: not a history of meshctl: found the tables photos"):
        FrameStore.open(foreign, DAY_S, MIN_BYTES)
    with pytest.raises(MeshctlError, match=r"photos\.sqlite: "):
        FrameStore.open_recording(foreign)
    assert [file.name for file in tmp_path.iterdir()] == ["photos.sqlite"]
    assert foreign.read_bytes() == before


def test_the_revision_follows_every_change_also_of_another_process(store: FrameStore, path: Path) -> None:
    seen = [store.revision()]

    def is_new() -> bool:
        seen.append(store.revision())
        return seen[-1] not in seen[:-1]

    assert seen[0] == store.revision()
    store.append(frame(1.0, {("b01", "weak"): "warning"}))
    assert is_new()
    store.acknowledge("b01", "weak", "alice", 2.0)
    assert is_new()
    with FrameStore.open_running(path) as other:
        other.silence("b01", "weak", Silence(None, "known", "bob"), 0.0)
    assert is_new()
    assert not is_new()


def test_a_damaged_frame_is_left_out(store: FrameStore, path: Path) -> None:
    for index in range(3):
        store.append(frame(float(index + 1)))
    with sqlite3.connect(path) as database:
        database.execute("UPDATE frames SET document = x'00ff' WHERE time_ms = 2000")
    database.close()
    assert times(store.after(0)) == [1.0, 3.0]
    assert times(store.between(0, 9, 9)) == [1.0, 3.0]
