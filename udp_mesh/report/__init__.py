"""Recordings of a run, simulated or real -> the monitor's page with the run in it, text, or JSON.

recording lines -> `recording` (items) -> `aggregate.Recording` (bounded) -> `figures` (numbers) -> `document` (tables,
charts, events) -> `page` or `text`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from udp_mesh.report.aggregate import Recording

MAX_SHOWN_PROBLEMS = 5
"""Maximum number of problems printed per recording; the page counts all of them."""
DEFAULT_PAGE = Path("report.html")


def documents_of(files: Iterable[Path]) -> Iterator[dict[str, Any]]:
    """The documents (`udp_mesh.report.document`) of recordings, one by one, for meshctl's page. Raises ValueError."""
    from udp_mesh.report.aggregate import read
    from udp_mesh.report.document import document_of

    return (document_of(read(file)) for file in files)


def main(arguments: Sequence[str]) -> int:
    """`udp-mesh report RECORDING... --out PAGE`; 0 success, 2 a recording is not readable or the page not writable."""
    from udp_mesh.report.aggregate import read
    from udp_mesh.report.document import document_of
    from udp_mesh.report.figures import summary
    from udp_mesh.report.page import page_writer
    from udp_mesh.report.terminal_escapes import clean
    from udp_mesh.report.text import text_of

    options = _options(arguments)
    write_page = None if options.text else page_writer()
    if write_page is None and options.out is not None:
        print(
            "udp-mesh: --out: the page needs meshctl, which is not installed here: run this on the operator's "
            "computer, or leave --out away for text",
            file=sys.stderr,
        )
        return 2
    page: Path | None = None
    if options.out is not None and any(_is_same(options.out, path) for path in options.recording):
        print(f"udp-mesh: --out: expected another file, found the recording {options.out}", file=sys.stderr)
        return 2
    problems: list[str] = []
    summaries: list[dict[str, Any]] = []

    def documents() -> Iterator[dict[str, Any]]:
        """One recording after the other, so that one at a time is in memory."""
        for path in options.recording:
            recording = read(path)
            problems.extend(_problems_of(recording))
            if options.json:
                summaries.append(summary(recording))
            yield document_of(recording)

    texts: list[str] = []
    try:
        if write_page is not None:
            page = options.out or DEFAULT_PAGE
            write_page(options.recording, documents(), page, options.title)
        else:
            texts = [text_of(document) for document in documents()]
    except ValueError as error:
        print(f"udp-mesh: {clean(str(error))}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"udp-mesh: {error.filename}: {error.strerror}", file=sys.stderr)
        return 2
    for problem in problems:
        print(f"udp-mesh: warning: {clean(problem)}", file=sys.stderr)
    if options.json:
        value = {"page": None if page is None else str(page), "recordings": summaries}
        print(json.dumps(value, indent=2))
    elif page is not None:
        print(page)
    else:
        print("\n\n".join(texts))
    return 0


def _is_same(path: Path, other: Path) -> bool:
    return path.exists() and other.exists() and path.samefile(other)


def _options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="udp-mesh report",
        description="Turn recordings into one HTML page: the mesh and the robots over time, tables, charts and events. "
        "Without meshctl, as on a robot, print the tables as text.",
        epilog="exit codes: 0 success, 2 invalid recording or page not writable, 130 interrupted\n\n"
        "example: udp-mesh report base.jsonl spot1.jsonl --out run.html",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recording", type=Path, nargs="+", help="written by `udp-mesh record` or `udp-mesh sim --out`")
    parser.add_argument("--title", default="udp_mesh run", help="title of the page (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="also print the numbers as JSON")
    shape = parser.add_mutually_exclusive_group()
    shape.add_argument("--out", type=Path, help=f"output file (default: {DEFAULT_PAGE})")
    shape.add_argument("--text", action="store_true", help="print the tables as text and write no page")
    return parser.parse_args(list(arguments))


def _problems_of(recording: Recording) -> list[str]:
    shown = recording.problems[:MAX_SHOWN_PROBLEMS]
    more = recording.invalid_lines - len(shown)
    return [*shown, *([f"... and {more} more invalid lines"] if more > 0 else [])]
