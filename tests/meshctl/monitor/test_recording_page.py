"""`udp-mesh report` with a page: what it leaves behind when it is ended, and how much it keeps of a long run."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from meshctl.monitor import page as page_module
from meshctl.monitor.frame import Frame
from meshctl.monitor.page import PART_CHARACTERS, recording_of, single_file
from meshctl.monitor.recording_page import PackedDocuments
from meshctl.monitor.store import MIN_BYTES, FrameStore
from meshctl.monitor.transport_recording import MAX_MOMENTS, SampleFile, read_recording
from tests.meshctl.monitor.recordings import write_recording
from tests.waiting import until


@contextmanager
def report_under_way(directory: Path, out: str = "run.html") -> Iterator[subprocess.Popen[bytes]]:
    """A report that waits for its recording, a pipe without a writer, and has its temporary files."""
    pipe = directory / "pipe.jsonl"
    if not pipe.exists():
        os.mkfifo(pipe)
    command = [sys.executable, "-m", "udp_mesh.cli.main", "report", str(pipe), "--out", str(directory / out)]
    before = set(hidden(directory))
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        until(lambda: set(hidden(directory)) - before or None, "temporary files of the report")
        yield process
    finally:
        process.kill()
        process.wait()


def hidden(directory: Path) -> list[str]:
    return [path.name for path in directory.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM)])
def test_a_report_that_is_ended_leaves_no_files(tmp_path: Path, number: signal.Signals, code: int) -> None:
    with report_under_way(tmp_path) as process:
        process.send_signal(number)
        assert process.wait(60) == code
    assert [path.name for path in tmp_path.iterdir()] == ["pipe.jsonl"]


def test_the_next_report_removes_what_a_killed_one_left_and_nothing_of_a_running_one(tmp_path: Path) -> None:
    with report_under_way(tmp_path) as killed:
        (left,) = hidden(tmp_path)
        killed.kill()
        killed.wait(60)
    with report_under_way(tmp_path, "other.html"):
        used = until(lambda: [name for name in hidden(tmp_path) if name != left], "its temporary files")
        assert hidden(tmp_path) == used
        recording = write_recording(tmp_path / "base.jsonl", "base")
        command = [sys.executable, "-m", "udp_mesh.cli.main", "report", str(recording), "--out", str(tmp_path / "run")]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        assert hidden(tmp_path) == used


def test_samples_of_a_long_recording_are_thinned_and_both_ends_kept(tmp_path: Path) -> None:
    seconds = 30_000
    file = tmp_path / "long.jsonl"
    with file.open("w") as out:
        out.write(json.dumps({"recording": 1, "node": "spot1", "started": 1000.0}) + "\n")
        for t in range(seconds):
            out.write(json.dumps({"t": t, "kind": "conditions", "peers": []}) + "\n")
            out.write(json.dumps({"t": t, "kind": "place", "x": t, "y": 0}) + "\n")
    with SampleFile(tmp_path) as samples:
        (robot,) = read_recording(file, samples, lambda text: None)
        # the whole of the beginning, and then ever fewer of more time
        assert list(robot.times_s[:100]) == [1000.0 + t for t in range(100)]
        assert len(robot.times_s) < 2.5 * MAX_MOMENTS
        assert robot.times_s[-1] >= 1000 + seconds - 10
        found = robot.at(1000.0 + seconds / 2)
        assert found is not None
        assert found[0] == pytest.approx(1000 + seconds / 2, abs=3)
        place = robot.place_at(1000.0 + seconds / 2)
        assert place is not None
        assert place["x_m"] == pytest.approx(seconds / 2, abs=3)
    # the samples' file has no name
    assert list(tmp_path.iterdir()) == [file]


def test_the_frames_in_a_page_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_module, "MAX_FRAMES_BYTES", 200_000)
    # hardly compressible
    text = os.urandom(20_000).hex()
    with FrameStore.open(tmp_path / "history.sqlite", 1e9, 4 * MIN_BYTES) as store:
        for number in range(200):
            status = {"nodes": [{"name": f"{text[number * 100 :]}{text[: number * 100]}"}], "robots": []}
            store.append(Frame.of({"time_s": 1000.0 + number, "fleet": "f", "status": status}))
        recording = recording_of(store, {})
        # the charts name the devices, too
        page = "".join(re.findall(r'class="frames">([^<]*)<', "".join(single_file(recording))))
        assert 2 <= recording.values["meta"]["frames"] < 200
        assert recording.values["meta"]["recorded_frames"] == 200
        assert len(page) <= 200_000


def test_frames_are_read_while_the_page_is_written(tmp_path: Path) -> None:
    with FrameStore.open(tmp_path / "history.sqlite", 1e9, 4 * MIN_BYTES) as store:
        for number in range(40):
            document = {"time_s": 1000.0 + number, "padding": "x" * (PART_CHARACTERS // 4), "status": {}}
            store.append(Frame.of(document))
        pieces = single_file(recording_of(store, {}))
        # head, one part per three frames, and the rest
        assert len(list(pieces)) == 1 + -(-40 // 3) + 1


class Document(dict[str, int]):
    """A document whose end can be seen."""


def test_documents_are_in_memory_one_at_a_time() -> None:
    made: list[weakref.ref[Document]] = []
    alive: list[int] = []

    def documents() -> Iterator[Document]:
        for number in range(5):
            alive.append(sum(one() is not None for one in made))
            document = Document(number=number)
            made.append(weakref.ref(document))
            yield document
            del document

    packed = PackedDocuments(documents())
    # the one before, which the loop lets go of next
    assert max(alive) <= 1
    assert [one["number"] for one in packed] == [one["number"] for one in packed] == list(range(len(packed)))
