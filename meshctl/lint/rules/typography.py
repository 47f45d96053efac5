"""Characters of word processors in values (MC005)."""

from __future__ import annotations

from collections.abc import Iterator

import yaml

from meshctl.diagnostics import Position, Severity
from meshctl.inventory.compose import yaml_events
from meshctl.lint.rule import Finding, text_rule

_QUOTES = "\u2018\u2019\u201a\u201b\u201c\u201d\u201e\u201f\u00ab\u00bb"


@text_rule(
    "MC005",
    Severity.WARNING,
    "A value has typographic quotes",
    why="""Word processors, chats and web pages replace straight quotes. YAML knows straight ones only: these become
    part of the value, such as a network name that no other node has.""",
    fix="Use straight quotes, or none. Put straight ones around a value that must keep these.",
    failing="meshes: {main: {ssid: \u201cfleet\u201d}}",
    passing='meshes: {main: {ssid: "fleet"}}',
)
def typographic_quotes(file: str, text: str) -> Iterator[Finding]:
    if not any(quote in text for quote in _QUOTES):
        return
    try:
        for event in yaml_events(text):
            if not isinstance(event, yaml.ScalarEvent) or event.style or not event.value:
                continue
            mark = event.start_mark
            if mark is not None and (event.value[0] in _QUOTES or event.value[-1] in _QUOTES):
                place = Position(file, mark.line + 1, mark.column + 1)
                yield Finding((), "typographic quotes", "straight quotes or none", position=place)
    except yaml.YAMLError:
        # the loader reports what is not YAML
        return
