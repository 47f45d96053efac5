"""Characters of word processors in values, and lists that repeat themselves (MC005 to MC006)."""

from __future__ import annotations

import re
from collections.abc import Iterator

import yaml

from meshctl.diagnostics import Position, Severity
from meshctl.inventory.compose import yaml_events
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates
from meshctl.lint.rule import Finding, fleet_rule, text_rule
from meshctl.model import Fleet

_QUOTES = "\u2018\u2019\u201a\u201b\u201c\u201d\u201e\u201f\u00ab\u00bb"
# without width, or marks of direction; joiners belong to words of some languages
_INVISIBLE = re.compile("[\u00ad\u200b\u200e\u200f\u202a-\u202e\u2060-\u2064\u2066-\u2069\ufeff]")
# beside ordinary spaces they are typography
_NO_BREAK = re.compile("[\u00a0\u2007\u202f]")


@text_rule(
    "MC005",
    Severity.WARNING,
    "A value has typographic quotes or invisible characters",
    why="""Word processors, chats and web pages replace straight quotes, and put in no-break spaces and characters
    without width. To YAML they are letters: they become part of the value, such as a network name that no other node
    has.""",
    fix="Type the value again, with straight quotes or none. Put straight quotes around a value that must keep these.",
    failing="meshes: {main: {ssid: \u201cfleet\u201d}}",
    passing='meshes: {main: {ssid: "fleet"}}',
)
def typographic_characters(file: str, text: str) -> Iterator[Finding]:
    if text.isascii():
        return
    try:
        for event in yaml_events(text):
            mark = event.start_mark
            if not isinstance(event, yaml.ScalarEvent) or not event.value or mark is None:
                continue
            place = Position(file, mark.line + 1, mark.column + 1)
            if not event.style and (event.value[0] in _QUOTES or event.value[-1] in _QUOTES):
                yield Finding((), "typographic quotes", "straight quotes or none", position=place)
            elif code := _unseen(event.value):
                yield Finding((), "an invisible character", "characters that can be seen", code, position=place)
    except yaml.YAMLError:
        # the loader reports what is not YAML
        return


def _unseen(value: str) -> str:
    """The first character that looks like a space or nothing and is neither, as U+200B."""
    found = _INVISIBLE.search(value) or (_NO_BREAK.search(value) if " " not in value else None)
    return f"U+{ord(found.group()):04X}" if found else ""


@fleet_rule(
    "MC006",
    Severity.WARNING,
    "A list contains a value twice",
    why="""The second one has no effect. It is usually a copy in which the name was not changed: a robot that gets no
    commands, or a package that is missing.""",
    fix="Write the name that was meant, or remove it.",
    failing="topics: {commands: {destinations: [husky1, husky1]}}",
    passing="topics: {commands: {destinations: [husky1]}}",
    is_fallback=True,
)
def listed_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for path, names in _lists(fleet):
        for name, (_, *repeated) in duplicates((name, index) for index, name in enumerate(names)):
            for index in repeated:
                yield Finding((*path, str(index)), "listed twice", "each value once", name)


def _lists(fleet: Fleet) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    yield ("system", "ntp_servers"), tuple(map(str, fleet.system.ntp_servers))
    for profile in fleet.hardware.values():
        yield ("hardware", profile.name, "packages"), profile.packages
    for node in fleet.managed():
        yield ("nodes", node.name, "packages"), node.packages
    for robot in fleet.robots.values():
        yield ("robots", robot.name, "relay"), robot.relay
    for topic in fleet.topics:
        yield ("topics", topic.name, "sources"), topic.sources
        yield ("topics", topic.name, "destinations"), topic.destinations
