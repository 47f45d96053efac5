"""The daemon's metrics -> a Markdown page: one sample page of Prometheus text, with every family in it, is rendered."""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Mapping
from enum import Enum
from types import NoneType
from typing import Any

_PARTS_OF_HISTOGRAM = re.compile("_(bucket|sum|count)$")


def metrics_page() -> str:
    """Every metric family that the daemon can print, except its process's own counters."""
    from udp_mesh.core.conditions import Conditions
    from udp_mesh.daemon.latencies import Histogram
    from udp_mesh.daemon.metrics import render
    from udp_mesh.daemon.radio_paths import RadioReport
    from udp_mesh.daemon.status import TopicCount

    latencies = {0: Histogram()}
    text = render(
        *(_sample(Conditions), {"map": _sample(TopicCount)}, {}),
        about={"version": "1"},
        uptime_s=1.0,
        latencies=latencies,
        radio=_sample(RadioReport),
    )
    families: dict[str, tuple[str, str, str]] = {}
    help_texts: dict[str, str] = {}
    for line in text.splitlines():
        words = line.split(" ", 3)
        if line.startswith("# HELP"):
            help_texts[words[2]] = words[3]
        elif line.startswith("# TYPE"):
            families[words[2]] = (words[3], "", help_texts[words[2]])
        else:
            name, brace, labels = words[0].partition("{")
            name = _PARTS_OF_HISTOGRAM.sub("", name) if name not in families else name
            # the buckets come first, and have all labels
            if families[name][1]:
                continue
            kind, _, meaning = families[name]
            names = ", ".join(f"`{label.split('=')[0]}`" for label in labels.rstrip("}").split(",")) if brace else ""
            families[name] = (kind, names, meaning)
    rows = [f"| `{name}` | {kind} | {labels} | {meaning} |" for name, (kind, labels, meaning) in families.items()]
    parts = [
        "# Metrics",
        "Generated from the daemon. `udp-mesh metrics` prints them in the text format of Prometheus; with"
        "\n`metrics_address` in `[daemon]` they are served at `GET /metrics` on a loopback address. The daemon's own"
        "\ncounters of its outbox, recordings and refused datagrams follow them under the same prefix.",
        "\n".join(["| metric | type | labels | meaning |", "| --- | --- | --- | --- |", *rows]),
    ]
    return "\n\n".join(parts) + "\n"


def _sample(kind: Any) -> Any:
    """A value of a type, with one element in every collection and no None."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = typing.get_type_hints(kind)
        return kind(**{field.name: _sample(hints[field.name]) for field in dataclasses.fields(kind)})
    arguments = [each for each in typing.get_args(kind) if each not in (NoneType, ...)]
    origin = typing.get_origin(kind)
    if origin is tuple:
        return tuple(_sample(each) for each in arguments)
    if origin is Mapping:
        key, value = arguments
        return {_sample(key): _sample(value)}
    if arguments:
        return _sample(arguments[0])
    if isinstance(kind, type) and issubclass(kind, Enum):
        return next(iter(kind))
    return kind(1)
