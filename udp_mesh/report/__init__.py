"""Recordings of a run, simulated or real -> one HTML page with charts.

recording lines -> `recording.Recording` -> `figures` (numbers) -> `charts` (SVG) -> `page` (HTML).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

MAX_SHOWN_PROBLEMS = 5
"""Maximum number of problems printed per recording; the page counts all of them."""


def main(arguments: Sequence[str]) -> int:
    """`udp-mesh report RECORDING... --out PAGE`; 0 success, 2 a recording is not readable or the page not writable."""
    from udp_mesh.report.figures import summary
    from udp_mesh.report.page import write_page
    from udp_mesh.report.recording import RecordingError, read
    from udp_mesh.report.terminal_escapes import clean

    parser = argparse.ArgumentParser(
        prog="udp-mesh report",
        description="Turn recordings into one HTML page with charts.",
        epilog="exit codes: 0 success, 2 invalid recording or page not writable, 130 interrupted\n\n"
        "example: udp-mesh report base.jsonl --out run.html",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recording", type=Path, nargs="+", help="written by `udp-mesh record` or `udp-mesh sim --out`")
    parser.add_argument("--out", type=Path, default=Path("report.html"), help="output file (default: %(default)s)")
    parser.add_argument("--title", default="udp_mesh run", help="title of the page (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="also print the numbers as JSON")
    options = parser.parse_args(list(arguments))
    try:
        recordings = [read(path) for path in options.recording]
        write_page(recordings, options.out, options.title)
    except RecordingError as error:
        print(f"udp-mesh: {clean(str(error))}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"udp-mesh: {error.filename}: {error.strerror}", file=sys.stderr)
        return 2
    for recording in recordings:
        for problem in recording.problems[:MAX_SHOWN_PROBLEMS]:
            print(f"udp-mesh: warning: {clean(str(problem))}", file=sys.stderr)
        more = len(recording.problems) - MAX_SHOWN_PROBLEMS
        if more > 0:
            print(f"udp-mesh: warning: ... and {more} more invalid lines", file=sys.stderr)
    if options.json:
        value = {"page": str(options.out), "recordings": [summary(recording) for recording in recordings]}
        print(json.dumps(value, indent=2))
    else:
        print(options.out)
    return 0
