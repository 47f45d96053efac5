"""Recordings to show instead of a running fleet: a history of `meshctl monitor`, recordings of udp-mesh, or both."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

from meshctl.errors import InputError
from meshctl.monitor.recorded_frames import frames_of, with_recorded
from meshctl.monitor.store import FrameStore
from meshctl.monitor.transport_recording import SampleFile, joined_by_name, read_recording

_SQLITE = b"SQLite format 3\x00"
# The distances of so many frames tell how far apart they usually are.
_SAMPLE = 50
_FOREVER_S = 1e10
_NO_LIMIT_BYTES = 1 << 40


@dataclass(frozen=True, slots=True)
class OpenedRecording:
    """`interval_s` is the usual time between two frames; `problems` says which lines were ignored."""

    store: FrameStore
    fleet: str
    interval_s: float
    topic_classes: Mapping[str, str] = field(default_factory=dict)
    problems: tuple[str, ...] = ()


@contextmanager
def open_recordings(files: Sequence[Path], directory: Path, fleet: str = "recording") -> Iterator[OpenedRecording]:
    """Open recordings for reading: one history, recordings of udp-mesh, or a history with recordings that add what its
    robots recorded while out of reach. `directory` is for temporary files; `fleet` names recordings without a history.
    Raises InputError with the file's name.
    """
    histories = [file for file in files if is_history(file)]
    if len(histories) > 1:
        raise InputError(f"expected one history, found {len(histories)}: {', '.join(map(str, histories))}")
    if len(histories) == len(files):
        with FrameStore.open_recording(histories[0]) as store:
            yield _opened(store, str(histories[0]))
        return
    problems: list[str] = []
    # the same reader for all: frames of recordings become a history of their own
    with FrameStore.open(directory / "merged.sqlite", _FOREVER_S, _NO_LIMIT_BYTES) as merged:
        with SampleFile(directory) as samples:
            recordings = (file for file in files if file not in histories)
            robots = [robot for file in recordings for robot in read_recording(file, samples, problems.append)]
            if histories:
                with FrameStore.open_recording(histories[0]) as store:
                    known = joined_by_name(robots)
                    for frame in store.after(0.0):
                        merged.append(with_recorded(frame, known))
            else:
                for frame in frames_of(robots, fleet):
                    merged.append(frame)
        yield replace(_opened(merged, ", ".join(map(str, files))), problems=tuple(problems))


def is_history(file: Path) -> bool:
    """Whether the file is an SQLite database. Raises InputError if it cannot be read."""
    try:
        with file.open("rb") as opened:
            return opened.read(len(_SQLITE)) == _SQLITE
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from error


def _opened(store: FrameStore, file: str) -> OpenedRecording:
    span = store.span()
    newest = store.latest()
    if span is None or newest is None:
        raise InputError(f"{file}: expected frames, found an empty history")
    times = [bucket.start_s for bucket in store.timeline(*span, 2000) if bucket.frames] if span[1] > span[0] else []
    gaps = [later - earlier for earlier, later in pairwise(times[:_SAMPLE])]
    airtime = newest.document.get("airtime")
    stated = airtime.get("interval_s") if isinstance(airtime, dict) else None
    interval_s = float(stated) if isinstance(stated, int | float) else statistics.median(gaps) if gaps else 5.0
    classes = newest.document.get("topic_classes")
    return OpenedRecording(
        store,
        str(newest.document.get("fleet") or "recording"),
        max(0.5, interval_s),
        {str(name): str(kind) for name, kind in classes.items()} if isinstance(classes, dict) else {},
    )
