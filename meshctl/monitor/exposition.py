"""Families of samples -> Prometheus text format (exposition format 0.0.4). Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
Labels = Mapping[str, object]


@dataclass(slots=True)
class MetricFamily:
    """One metric: `kind` is `gauge` or `counter`; samples are labels and a value."""

    name: str
    kind: str
    help_text: str
    samples: list[tuple[Labels, float]] = field(default_factory=list)

    def add(self, value: object, **labels: object) -> None:
        """Add a sample; what is not a finite number is unknown, and left out. Labels that are None are empty."""
        if isinstance(value, bool | int | float):
            with suppress(OverflowError):
                number = float(value)
                if math.isfinite(number):
                    self.samples.append((labels, number))


def exposition(families: Iterable[MetricFamily]) -> str:
    """The page; families without a sample are left out, and of two samples with the same labels the first counts."""
    lines: list[str] = []
    for family in families:
        rows = {_labels(labels): value for labels, value in reversed(family.samples)}
        if not rows:
            continue
        lines += [f"# HELP {family.name} {_help(family.help_text)}", f"# TYPE {family.name} {family.kind}"]
        lines += [f"{family.name}{labels} {_number(rows[labels])}" for labels in reversed(rows)]
    return "\n".join(lines) + "\n"


def _labels(labels: Labels) -> str:
    inner = ",".join(f'{name.rstrip("_")}="{_escape(value)}"' for name, value in labels.items())
    return f"{{{inner}}}" if inner else ""


def _escape(value: object) -> str:
    text = "" if value is None else str(value)
    return text.replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')


def _help(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n")


def _number(value: float) -> str:
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
