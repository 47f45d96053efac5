"""Requests and replies between operator and worker: one JSON object a line.

A request is `{"do": NAME, ...}`. Its reply is `{"reply": {...}}` or `{"error": TEXT, "hint": TEXT}`. While a request
takes its time the worker sends `{"beat": SECONDS}`, so that silence means a lost uplink. `follow` has many replies, the
last one with `over`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from meshctl.errors import MeshctlError

PROTOCOL = 1
BEAT_S = 5.0
# Four beats: a retransmission on a bad uplink takes a few seconds.
SILENCE_S = 20.0
# A batch of events: a site's run makes some kilobytes a second.
MAX_EVENTS_BYTES = 256 << 10


class WorkerError(MeshctlError):
    """A refusal of a request by the worker."""


def encode(message: Mapping[str, object]) -> bytes:
    return json.dumps(dict(message), separators=(",", ":")).encode()


def decode(line: bytes) -> dict[str, Any]:
    """Raises WorkerError for a line that is no message, such as what a login shell prints."""
    try:
        message = json.loads(line)
    except ValueError:
        message = None
    if not isinstance(message, dict):
        shown = line[:80].decode("utf-8", "replace")
        raise WorkerError(
            f"expected a worker's message, found {shown!r}",
            hint="the shell's start-up files on the gateway must not print anything",
        )
    return message


def error_message(error: MeshctlError) -> dict[str, object]:
    return {"error": str(error), "hint": error.hint}


def raise_error(message: Mapping[str, Any], site: str) -> None:
    """Raise the error of a message, if it is one."""
    if "error" in message:
        raise WorkerError(f"site {site}: {message['error']}", hint=str(message.get("hint", "")))
