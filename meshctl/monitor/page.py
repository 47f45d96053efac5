"""The page's files, and the page as one HTML file with a recording in it.

The page is hand-written ES modules without a build step. For the single file they are joined in the order of their
imports: each module imports by name, from files of its own directory, and no two define the same name (a test checks
both). The recording is JSON, packed, in elements that no browser executes: one with all but the frames, and the frames
in parts that the page unpacks as it needs them, so that hours of a large team stay usable. The policy in the file
allows exactly its own scripts and styles, by hash, and no network.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from meshctl.monitor.series import charts_of, devices_of
from meshctl.monitor.store import FrameStore

ASSETS = Path(__file__).resolve().parent / "assets"
_MAIN = "main.js"
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
# Of all frames; packed they are about a tenth of it.
MAX_FRAME_CHARACTERS = 256 << 20
# The browser unpacks so much at once.
PART_CHARACTERS = 1 << 20


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
    report: Sequence[Mapping[str, Any]] = (),
    limit: int = MAX_FRAMES,
) -> dict[str, Any]:
    """What the page shows of a history, as one document; `frames` are JSON texts, evenly thinned to `limit` and to
    `MAX_FRAME_CHARACTERS`. `report` are the documents of udp-mesh's recordings. Raises ValueError for an empty history.
    """
    span = store.span()
    if span is None:
        raise ValueError("the history has no frame")
    charted = store.between(*span, MAX_CHART_FRAMES)
    typical = max(1, sum(len(frame.json_text) for frame in charted) // len(charted))
    frames = store.between(*span, max(2, min(limit, MAX_FRAME_CHARACTERS // typical)))
    return {
        "meta": {
            **settings,
            "mode": "replay",
            "span": span,
            "now_s": span[1],
            "actions": False,
            "can_acknowledge": False,
            "frames": len(frames),
            "recorded_frames": store.count(),
        },
        "times_s": [frame.time_s for frame in frames],
        "frames": [frame.json_text for frame in frames],
        "alarms": [alarm.as_json() for alarm in store.alarms(active_only=False, now_s=span[1])],
        "timeline": {"buckets": [asdict(one) for one in store.timeline(span[0], span[1] + 0.001, TIMELINE_BUCKETS)]},
        "series": {device: {"charts": charts_of(charted, device)} for device in devices_of(charted)},
        "report": list(report),
    }


def single_file(recording: Mapping[str, Any]) -> str:
    """The page with a recording in it: opens from disk, without a server."""
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
    frames = recording.get("frames", ())
    parts = _parts(frames)
    rest = {**recording, "frames": [len(part) for part in parts]}
    data = "\n".join(
        [
            f'<script type="application/json" id="recording">{_packed(json.dumps(rest, **_JSON))}</script>',
            *(
                f'<script type="application/json" class="frames">{_packed("[" + ",".join(part) + "]")}</script>'
                for part in parts
            ),
        ]
    )
    return html.replace('<meta charset="utf-8">', head, 1).replace("<body>", f"<body>\n{data}", 1)


def _parts(frames: Sequence[str]) -> list[list[str]]:
    """Consecutive frames together, up to `PART_CHARACTERS`."""
    parts: list[list[str]] = []
    characters = PART_CHARACTERS
    for frame in frames:
        if characters + len(frame) > PART_CHARACTERS:
            parts.append([])
            characters = 0
        parts[-1].append(frame)
        characters += len(frame)
    return parts


def _packed(text: str) -> str:
    """gzip in base64, which no text of a device can leave."""
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


def _hashes(texts: Sequence[str]) -> str:
    return " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in texts)


def _checked(text: str, end: str) -> str:
    if end in text.lower():
        raise ValueError(f"a file of the page contains {end}, which would end its element")
    return text


def _read(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")
