"""The page of `udp-mesh report`, which finds it by the entry point `udp_mesh.report` of this distribution; and, by
`meshctl.recordings`, the tables and charts that udp-mesh makes of its recordings."""

from __future__ import annotations

import itertools
import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from meshctl import __version__
from meshctl.errors import InputError, MeshctlError
from meshctl.monitor.page import is_replaceable, recording_of, save_page
from meshctl.monitor.replay import open_recordings
from meshctl.monitor.scratch import scratch_directory
from meshctl.monitor.server import PageSettings

GROUP = "meshctl.recordings"


def documents_of(files: Iterable[Path]) -> PackedDocuments:
    """The tables, charts and events of recordings (udp_mesh/report/document.py). Raises InputError."""
    try:
        return PackedDocuments(itertools.chain(*(entry.load()(list(files)) for entry in entry_points(group=GROUP))))
    except ValueError as error:
        raise InputError(str(error)) from error


def write_page(recordings: Sequence[Path], documents: Iterable[Mapping[str, Any]], page: Path, title: str) -> None:
    """The monitor's page with recordings of udp-mesh in it, as one file that replaces an older one at once. The
    documents are taken one at a time.

    Raises OSError with the page's name, or ValueError if the recordings cannot be shown.
    """
    try:
        # in the page's directory: a page that cannot be written fails before the work
        with scratch_directory(page.parent) as directory:
            packed = PackedDocuments(documents)
            try:
                with open_recordings(recordings, directory, title) as opened:
                    settings = PageSettings(
                        title, __version__, "replay", opened.interval_s, opened.topic_classes, has_report=True
                    )
                    save_page(recording_of(opened.store, settings.as_json(), packed), page, directory)
            except MeshctlError as error:
                raise ValueError(str(error)) from error
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(page)) from error


@contextmanager
def scratch_for(out: Path | None) -> Iterator[Path]:
    """A directory for temporary files: beside the page, which is put in place at once, or where others are. Raises
    InputError."""
    parent = out.parent if out is not None and is_replaceable(out) else None
    with ExitStack() as stack:
        try:
            directory = stack.enter_context(scratch_directory(parent))
        except OSError as error:
            raise InputError(f"cannot write {out or error.filename}: {error.strerror}") from error
        yield directory


class PackedDocuments:
    """Documents, kept packed: those of a large team are hundreds of megabytes as Python's values."""

    def __init__(self, documents: Iterable[Mapping[str, Any]]) -> None:
        self._packed = [zlib.compress(json.dumps(document).encode(), 1) for document in documents]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (json.loads(zlib.decompress(packed)) for packed in self._packed)

    def __len__(self) -> int:
        return len(self._packed)
