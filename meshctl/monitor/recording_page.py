"""The page of `udp-mesh report`, which finds it by the entry point `udp_mesh.report` of this distribution; and, by
`meshctl.recordings`, the tables and charts that udp-mesh makes of its recordings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from meshctl import __version__
from meshctl.errors import InputError, MeshctlError
from meshctl.monitor.page import recording_of, single_file
from meshctl.monitor.replay import open_recordings
from meshctl.monitor.server import PageSettings

GROUP = "meshctl.recordings"


def documents_of(files: Iterable[Path]) -> list[dict[str, Any]]:
    """The tables, charts and events of recordings (udp_mesh/report/document.py). Raises InputError."""
    found: list[dict[str, Any]] = []
    for entry in entry_points(group=GROUP):
        try:
            found += entry.load()(files)
        except ValueError as error:
            raise InputError(str(error)) from error
    return found


def write_page(recordings: Sequence[Path], documents: Sequence[Mapping[str, Any]], page: Path, title: str) -> None:
    """The monitor's page with recordings of udp-mesh in it, as one file that replaces an older one at once.

    Raises OSError with the page's name, or ValueError if the recordings cannot be shown.
    """
    try:
        # in the page's directory: a page that cannot be written fails before the work
        with TemporaryDirectory(dir=page.parent, prefix=".report-") as directory:
            try:
                with open_recordings(recordings, Path(directory), title) as opened:
                    settings = PageSettings(
                        title, __version__, "replay", opened.interval_s, opened.topic_classes, has_report=True
                    )
                    text = single_file(recording_of(opened.store, settings.as_json(), documents))
            except MeshctlError as error:
                raise ValueError(str(error)) from error
            unfinished = Path(directory) / "page"
            unfinished.write_text(text, "utf-8")
            unfinished.replace(page)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(page)) from error
