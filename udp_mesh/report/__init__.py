"""From a recording of a run, simulated or real, to one HTML page with its pictures.

recording lines -> `recording.Recording` -> `figures` (numbers) -> `charts` (SVG) -> `page` (HTML).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str]) -> int:
    """`udp-mesh report RECORDING... --out PAGE`; 0 written, 2 a recording cannot be read or the page not written."""
    from udp_mesh.report.page import write_page
    from udp_mesh.report.recording import RecordingError, read

    parser = argparse.ArgumentParser(
        prog="udp-mesh report",
        description="Turn recordings of a run into one HTML page with its pictures.",
        epilog="example: udp-mesh report base.jsonl --out run.html",
    )
    parser.add_argument("recording", type=Path, nargs="+", help="made by `udp-mesh record` or `udp-mesh sim --out`")
    parser.add_argument("--out", type=Path, default=Path("report.html"), help="the page (default: report.html)")
    parser.add_argument("--title", default="udp_mesh run")
    chosen = parser.parse_args(list(arguments))
    try:
        recordings = [read(path) for path in chosen.recording]
        write_page(recordings, chosen.out, chosen.title)
    except (RecordingError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for problem in (problem for recording in recordings for problem in recording.problems[:5]):
        print(f"warning: {problem}", file=sys.stderr)
    print(chosen.out)
    return 0
