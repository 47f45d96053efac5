"""The page's files, and the page as one HTML file with a recording in it.

The page is hand-written ES modules without a build step. For the single file they are joined in the order of their
imports: each module imports by name, from files of its own directory, and no two define the same name (a test checks
both). The recording is JSON, packed, in elements that no browser executes: one with all but the frames, and the frames
in parts that the page unpacks as it needs them, so that hours of a large team stay usable. Frames are read, packed and
written one part at a time, so that they need not fit into memory. The policy in the file allows exactly its own scripts
and styles, by hash, and no network.
"""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from meshctl.monitor.frame import Frame
from meshctl.monitor.series import DeviceCharts
from meshctl.monitor.store import FrameStore

ASSETS = Path(__file__).resolve().parent / "assets"
_MAIN = "main.js"
# zlib's window of 32 KiB, with a gzip header
_GZIP = 31
_JSON: dict[str, Any] = {"separators": (",", ":"), "ensure_ascii": False, "allow_nan": False}
_IMPORT = re.compile(r'^import \{[^}]*\} from "\./([a-z]+\.js)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|const|class)\b)", re.MULTILINE)
_TAG = re.compile(
    r'<(?:script(?: type="module")? src|link rel="(stylesheet|icon)" href)="assets/([\w./-]+)"[^>]*>(?:</script>)?'
)
# More frames than a slider has places for only make the file larger.
MAX_FRAMES = 3600
MAX_CHART_FRAMES = 600
TIMELINE_BUCKETS = 480
# Of all frames, in the file; as the first part of evenly spread ones packs.
MAX_FRAMES_BYTES = 32 << 20
# The browser unpacks so much at once.
PART_CHARACTERS = 1 << 20


@dataclass(frozen=True, slots=True)
class PageRecording:
    """The part of a history that the page shows. `values` are all but the frames, `reports` the documents of udp-mesh's
    recordings, one after the other; `frames` are read while the page is written."""

    values: Mapping[str, Any]
    reports: Iterable[Mapping[str, Any]] = ()
    frames: Iterable[Frame] = ()


def modules(main: str = _MAIN) -> list[str]:
    """The page's modules, imported ones before their importers."""
    found: list[str] = []

    def visit(name: str) -> None:
        if name in found:
            return
        for wanted in _IMPORT.findall(_read(name)):
            visit(wanted)
        found.append(name)

    visit(main)
    return found


def joined_modules() -> str:
    """All modules as one."""
    return "\n".join(f"// {name}\n{_EXPORT.sub('', _IMPORT.sub('', _read(name)))}" for name in modules())


def recording_of(
    store: FrameStore,
    settings: Mapping[str, Any],
    reports: Iterable[Mapping[str, Any]] = (),
    limit: int = MAX_FRAMES,
) -> PageRecording:
    """The recording of a history for the page: its frames evenly thinned to `limit` and to `MAX_FRAMES_BYTES`. Raises
    ValueError for an empty history.
    """
    span = store.span()
    if span is None:
        raise ValueError("the history has no frame")
    charts = DeviceCharts()
    sample: list[str] = []
    characters = charted = 0
    for frame in store.between(*span, MAX_CHART_FRAMES):
        charts.add(frame)
        charted += 1
        characters += len(frame.json_text)
        if sum(map(len, sample)) < PART_CHARACTERS:
            sample.append(frame.json_text)
    # evenly spread frames have less in common than those of one part, so this is rather too much
    packed_bytes = len(_packed(["[", ",".join(sample), "]"])) * characters / charted / sum(map(len, sample))
    limit = max(2, min(limit, int(MAX_FRAMES_BYTES / packed_bytes)))
    recorded = store.count()
    values = {
        "meta": {
            **settings,
            "mode": "replay",
            "span": span,
            "now_s": span[1],
            "actions": False,
            "can_acknowledge": False,
            "frames": min(limit, recorded),
            "recorded_frames": recorded,
        },
        "alarms": [alarm.as_json() for alarm in store.alarms(active_only=False, now_s=span[1])],
        "timeline": {
            "buckets": [asdict(bucket) for bucket in store.timeline(span[0], span[1] + 0.001, TIMELINE_BUCKETS)]
        },
        "series": {device: {"charts": charts.of(device)} for device in charts.devices},
    }
    return PageRecording(values, reports, store.between(*span, limit))


def single_file(recording: PageRecording) -> Iterator[str]:
    """The page with a recording in it, in pieces: opens from disk, without a server."""
    scripts: list[str] = []
    styles: list[str] = []
    classic: list[str] = []

    def inline(match: re.Match[str]) -> str:
        kind, name = match.group(1), match.group(2)
        if kind == "icon":
            return ""
        if kind == "stylesheet":
            text = _read(name)
            styles.append(text)
            return f"<style>{_checked(text, '</style')}</style>"
        text = joined_modules() if name == _MAIN else _read(name)
        (scripts if name == _MAIN else classic).append(text)
        kind_attribute = ' type="module"' if name == _MAIN else ""
        return f"<script{kind_attribute}>{_checked(text, '</script')}</script>"

    html = _TAG.sub(inline, _read("index.html"))
    policy = (
        f"default-src 'none'; script-src {_hashes([*classic, *scripts])}; style-src {_hashes(styles)};"
        " base-uri 'none'; form-action 'none'; require-trusted-types-for 'script'"
    )
    head = f'<meta charset="utf-8">\n<meta http-equiv="Content-Security-Policy" content="{policy}">'
    before, body, after = html.replace('<meta charset="utf-8">', head, 1).partition("<body>")
    yield f"{before}{body}\n"
    times_s: list[float] = []
    counts: list[int] = []
    for part in _parts(recording.frames):
        times_s += [frame.time_s for frame in part]
        counts.append(len(part))
        text = ",".join(frame.json_text for frame in part)
        yield f'<script type="application/json" class="frames">{_packed(["[", text, "]"])}</script>\n'
    values = json.dumps({**recording.values, "times_s": times_s, "frames": counts}, **_JSON)
    reports = (
        f"{',' if number else ''}{json.dumps(report, **_JSON)}" for number, report in enumerate(recording.reports)
    )
    packed = _packed(itertools.chain([values[:-1], ',"report":['], reports, ["]}"]))
    yield f'<script type="application/json" id="recording">{packed}</script>\n{after}'


def save_page(recording: PageRecording, page: Path, directory: Path) -> int:
    """Write the page to `directory`, which is on the disk of `page`, then put it in the place of an older one; its
    size in bytes. A device or a pipe is written to. Raises OSError."""
    is_replaced = is_replaceable(page)
    unfinished = directory / "page" if is_replaced else page
    size = 0
    with unfinished.open("wb") as file:
        for piece in single_file(recording):
            size += file.write(piece.encode())
    if is_replaced:
        unfinished.replace(page)
    return size


def is_replaceable(page: Path) -> bool:
    """Whether the page is put in its place at once; a device or a pipe is written to."""
    return page.is_file() or not page.exists()


def _parts(frames: Iterable[Frame]) -> Iterator[list[Frame]]:
    """Consecutive frames together, up to `PART_CHARACTERS`."""
    part: list[Frame] = []
    characters = 0
    for frame in frames:
        if part and characters + len(frame.json_text) > PART_CHARACTERS:
            yield part
            part, characters = [], 0
        part.append(frame)
        characters += len(frame.json_text)
    if part:
        yield part


def _packed(pieces: Iterable[str]) -> str:
    """gzip in base64, which no text of a device can leave."""
    packer = zlib.compressobj(6, zlib.DEFLATED, _GZIP)
    found = [packer.compress(piece.encode()) for piece in pieces]
    return base64.b64encode(b"".join([*found, packer.flush()])).decode()


def _hashes(texts: Sequence[str]) -> str:
    return " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in texts)


def _checked(text: str, end: str) -> str:
    if end in text.lower():
        raise ValueError(f"a file of the page contains {end}, which would end its element")
    return text


def _read(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")
