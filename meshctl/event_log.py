"""Structured events for `--verbose` and `--log-file`: connections, commands on devices, steps of a run.

`emit` records an event with its fields; without a handler it costs one comparison. Secrets that were resolved in this
process (`hide`) are masked in every field. `JsonLines` writes one JSON object per event, `Lines` one line for people.
"""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime
from typing import TextIO

INFO, DEBUG = logging.INFO, logging.DEBUG
MASK = "***"
# Shorter values are words that stand in every command, not secrets worth masking.
MIN_SECRET_LENGTH = 6
# A script may have thousands of characters; its beginning identifies it.
MAX_FIELD_LENGTH = 400
_LOGGER = logging.getLogger("meshctl.events")
_LOGGER.propagate = False
_LOGGER.addHandler(logging.NullHandler())
# Events that the progress of a run shows anyway.
SHOWN_ELSEWHERE = frozenset({"step", "note", "started", "finished", "progress"})

_secrets: set[str] = set()


def hide(secret: str) -> None:
    """Mask this value, and each of its lines, in all later events."""
    _secrets.update(part for part in (secret, *secret.splitlines()) if len(part) >= MIN_SECRET_LENGTH)


def masked(text: str) -> str:
    """The text without the hidden values."""
    # the longest first: one secret may contain another
    for secret in sorted(_secrets, key=len, reverse=True):
        text = text.replace(secret, MASK)
    return text


def emit(level: int, event: str, **fields: str | float | int | None) -> None:
    """Record an event; fields that are None are left out."""
    if _LOGGER.isEnabledFor(level):
        given = {name: value for name, value in fields.items() if value is not None}
        _LOGGER.log(level, event, extra={"fields": given})


def is_verbose() -> bool:
    """Whether events are shown on the terminal."""
    return any(isinstance(each.formatter, Lines) for each in _LOGGER.handlers)


def add_handler(stream: TextIO, level: int, formatter: logging.Formatter) -> logging.Handler:
    """Write events of this level and above to `stream` until `remove_handler`."""
    handler = logging.StreamHandler(stream)
    handler.setLevel(level)
    handler.setFormatter(formatter)
    if isinstance(formatter, Lines):
        handler.addFilter(lambda record: record.getMessage() not in SHOWN_ELSEWHERE)
    _LOGGER.addHandler(handler)
    _LOGGER.setLevel(min(each.level for each in _LOGGER.handlers if each.level))
    return handler


def remove_handler(handler: logging.Handler) -> None:
    _LOGGER.removeHandler(handler)
    _LOGGER.setLevel(min((each.level for each in _LOGGER.handlers if each.level), default=logging.CRITICAL))


_LOGGER.setLevel(logging.CRITICAL)


def _fields(record: logging.LogRecord) -> dict[str, str | float | int]:
    fields: dict[str, str | float | int] = getattr(record, "fields", {})
    return {name: _shortened(masked(value)) if isinstance(value, str) else value for name, value in fields.items()}


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_FIELD_LENGTH else f"{text[:MAX_FIELD_LENGTH]}... ({len(text)} characters)"


class JsonLines(logging.Formatter):
    """`{"at": "2026-11-23T01:02:31.250Z", "level": "debug", "event": "command", "device": "b03 (...)", ...}`."""

    def format(self, record: logging.LogRecord) -> str:
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        head = {"at": at, "level": record.levelname.lower(), "pid": record.process, "event": record.getMessage()}
        return json.dumps({**head, **_fields(record)})


class Lines(logging.Formatter):
    """`01:02:31.250 command: device=b03 exit_status=0 duration_s=0.12 script=cat /proc/uptime`."""

    def format(self, record: logging.LogRecord) -> str:
        at = datetime.fromtimestamp(record.created).astimezone().strftime("%H:%M:%S.%f")[:-3]
        fields = " ".join(f"{name}={value}" for name, value in _fields(record).items())
        # no control character of a device or a script reaches the terminal
        line = f"{at} {record.getMessage()}: {fields}"
        return "".join(character if character.isprintable() else " " for character in line)
