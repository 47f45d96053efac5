"""Faulty disks, for outboxes."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def standing_disk(directory: Path, key: int) -> Iterator[Callable[[], None]]:
    """A disk that hangs at the file of `key` until the returned function is called: a pipe without a reader."""
    directory.mkdir(parents=True, exist_ok=True)
    pipe = directory / f"{key:020d}.new"
    os.mkfifo(pipe)
    readers: list[int] = []

    def go_on() -> None:
        if not readers:
            readers.append(os.open(pipe, os.O_RDWR))

    try:
        yield go_on
    finally:
        go_on()
        os.close(readers[0])
