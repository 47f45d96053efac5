"""Text -> YAML events (libyaml's parser if PyYAML has it) -> one tree, with all limits enforced.

The tree is built with an explicit stack, so deep nesting cannot exhaust Python's, and aliases share values, so an alias
bomb costs nothing before it is rejected. Tags, merge keys, keys that are not text and multiple documents are rejected.
Everything but a syntax error is reported together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import yaml

from meshctl.diagnostics import Diagnostic, Position
from meshctl.inventory import codes
from meshctl.inventory.source import Source
from meshctl.inventory.tree import MappingNode, Scalar, SequenceNode, Tree, position
from meshctl.inventory.yaml_mistakes import syntax_error

# The deepest place of the format, nodes.*.radios.*.mesh, is five levels down.
MAX_DEPTH = 32
# 10,000 nodes with 20 values each are 200,000. Bounds memory (about 300 bytes per value) and alias bombs.
MAX_VALUES = 1_000_000

# libyaml's, which is several times as fast, where PyYAML was built with it
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
# libyaml 0.2.6, in PyYAML from 6.0.4 on, stops at 1,000 levels. It reads ahead, so that can be before the event of the
# first level that is too deep here.
_LIBYAML_TOO_DEEP = "exceeded maximum nesting depth"


@dataclass(frozen=True, slots=True)
class Composed:
    """`root` is None if the text could not be parsed to its end; the diagnostics then say why."""

    root: Tree | None
    diagnostics: tuple[Diagnostic, ...]


def compose(source: Source) -> Composed:
    """The one document of `source`. Never raises for any text."""
    try:
        composer = _composed(source, LOADER)
    except _LibyamlTooDeep:
        # the parser in Python reads ahead less, so the place is that of the first level beyond MAX_DEPTH
        composer = _composed(source, yaml.SafeLoader)
    if composer.root is None and not composer.is_broken:
        composer.fail(codes.error(codes.EMPTY, Position(source.file, 1, 1), "the file is empty", expected="a mapping"))
    return Composed(None if composer.is_broken else composer.root, tuple(composer.diagnostics))


class _LibyamlTooDeep(Exception):
    """libyaml refused the nesting before the events of its levels arrived."""


def _composed(source: Source, loader: type[yaml.SafeLoader]) -> _Composer:
    """Raises _LibyamlTooDeep."""
    composer = _Composer(source.file)
    quote: yaml.ScalarEvent | None = None
    try:
        for event in yaml_events(source.text, loader):
            if not composer.handle(event):
                break
            if isinstance(event, yaml.ScalarEvent) and event.style in ("'", '"') and _is_of_several_lines(event):
                quote = event
    except yaml.MarkedYAMLError as reason:
        if reason.problem == _LIBYAML_TOO_DEEP:
            raise _LibyamlTooDeep from None
        composer.fail(syntax_error(source, reason, quote))
    except yaml.YAMLError as reason:
        composer.fail(codes.error(codes.YAML_SYNTAX, Position(source.file), f"not valid YAML: {reason}"))
    return composer


def _is_of_several_lines(event: yaml.Event) -> bool:
    start, end = _marks(event)
    return end.line > start.line


def yaml_events(text: str, loader: type[yaml.SafeLoader] = LOADER) -> Iterator[yaml.Event]:
    """Parse with libyaml if there is one. Raises YAMLError."""
    events: Iterator[yaml.Event] = yaml.parse(text, Loader=loader)
    return events


class _Mark(Protocol):
    """A position in the text, from 0, as in both of PyYAML's parsers."""

    line: int
    column: int
    index: int


def _marks(event: yaml.Event) -> tuple[_Mark, _Mark]:
    """Start and end of an event, which the parsers always set."""
    start, end = event.start_mark, event.end_mark
    assert start is not None
    assert end is not None
    return start, end


@dataclass(slots=True)
class _Composer:
    """The open containers, innermost last, each with its pending key and its anchor."""

    file: str
    root: Tree | None = None
    is_broken: bool = False
    diagnostics: list[Diagnostic] = field(default_factory=list)
    _open: list[tuple[SequenceNode | MappingNode, str | None]] = field(default_factory=list)
    _key: Scalar | None = None
    _waiting: list[Scalar | None] = field(default_factory=list)
    _anchors: dict[str, Tree] = field(default_factory=dict)
    _count: int = 0

    def fail(self, diagnostic: Diagnostic) -> None:
        self.is_broken = True
        self.diagnostics.append(diagnostic)

    def handle(self, event: yaml.Event) -> bool:
        """Handle one event; False to stop reading."""
        match event:
            case yaml.ScalarEvent():
                self._refuse_tag(event)
                self._scalar(event)
            case yaml.MappingStartEvent() | yaml.SequenceStartEvent():
                self._refuse_tag(event)
                self._start(event)
            case yaml.MappingEndEvent() | yaml.SequenceEndEvent():
                self._end(event)
            case yaml.AliasEvent():
                self._alias(event)
            case yaml.DocumentStartEvent() if self.root is not None:
                self._refuse(event, "a file must contain only one YAML document", hint="remove the line `---`")
                return False
            case _:
                pass
        return not self.is_broken

    def _scalar(self, event: yaml.ScalarEvent) -> None:
        start, end = _marks(event)
        is_plain = event.style in (None, "")
        scalar = Scalar(self.file, start.line + 1, start.column + 1, start.index, end.index, event.value, is_plain)
        self._add(scalar, event.anchor)

    def _start(self, event: yaml.MappingStartEvent | yaml.SequenceStartEvent) -> None:
        start, end = _marks(event)
        kind = MappingNode if isinstance(event, yaml.MappingStartEvent) else SequenceNode
        container = kind(
            self.file, start.line + 1, start.column + 1, start.index, end.index, is_flow=bool(event.flow_style)
        )
        if len(self._open) >= MAX_DEPTH:
            self.fail(
                codes.error(
                    codes.TOO_DEEP, position(container), "nested too deep", expected=f"at most {MAX_DEPTH} levels"
                )
            )
            return
        self._open.append((container, event.anchor))
        self._waiting.append(self._key)
        self._key = None

    def _end(self, event: yaml.MappingEndEvent | yaml.SequenceEndEvent) -> None:
        container, anchor = self._open.pop()
        container.end = _marks(event)[1].index
        self._key = self._waiting.pop()
        self._add(container, anchor)

    def _alias(self, event: yaml.AliasEvent) -> None:
        target = self._anchors.get(event.anchor or "")
        if target is None:
            inside = any(anchor == event.anchor for _, anchor in self._open)
            what = "is inside the value that it refers to" if inside else "refers to no earlier anchor"
            place = self._place(event)
            self.fail(codes.error(codes.YAML_FEATURE, place, f"the alias *{event.anchor} {what}"))
            return
        self._add(target, None)

    def _add(self, tree: Tree, anchor: str | None) -> None:
        """Add a complete value: a key, the value of an entry, an item of a list or the document."""
        if anchor is not None:
            self._anchors[anchor] = tree
        self._count += 1
        if not self._open:
            self.root = tree
            return
        container, _ = self._open[-1]
        if isinstance(container, MappingNode) and self._key is None:
            self._set_key(tree)
            return
        container.weight += tree.weight
        if max(container.weight, self._count) > MAX_VALUES:
            self.fail(
                codes.error(
                    codes.TOO_MANY_VALUES,
                    position(tree),
                    "too many values (with aliases expanded)",
                    expected=f"at most {MAX_VALUES}",
                    hint="write similar nodes as a range, and shared values as a group",
                )
            )
        elif isinstance(container, SequenceNode):
            container.items.append(tree)
        else:
            self._entry(container, tree)

    def _set_key(self, tree: Tree) -> None:
        if isinstance(tree, Scalar):
            self._key = tree
            return
        self.fail(codes.error(codes.YAML_FEATURE, position(tree), "a key must be text", found="a list or a mapping"))

    def _entry(self, mapping: MappingNode, value: Tree) -> None:
        key, self._key = self._key, None
        assert key is not None
        first = mapping.keys.get(key.text)
        if key.is_plain and key.text == "<<":
            mapping.is_partial = True
            hint = "write the values here; nodes share values with `groups` and `defaults`"
            self._note(codes.error(codes.YAML_FEATURE, position(key), "merge keys are not supported", hint=hint))
        elif first is not None:
            self._note(
                codes.error(
                    codes.DUPLICATE_KEY,
                    position(key),
                    f"duplicate key '{printable(key.text)}', first set on line {first.line}",
                )
            )
        else:
            mapping.keys[key.text] = key
            mapping.values[key.text] = value

    def _refuse_tag(self, event: yaml.ScalarEvent | yaml.MappingStartEvent | yaml.SequenceStartEvent) -> None:
        if event.tag is not None:
            hint = "remove it; quote a value that must stay text"
            self._refuse(event, f"YAML tags are not supported: {printable(event.tag)}", hint=hint)

    def _refuse(self, event: yaml.Event, message: str, *, hint: str) -> None:
        self._note(codes.error(codes.YAML_FEATURE, self._place(event), message, hint=hint))

    def _note(self, diagnostic: Diagnostic) -> None:
        """Report an error and go on, up to the limit of errors."""
        self.diagnostics.append(diagnostic)
        if len(self.diagnostics) >= codes.MAX_DIAGNOSTICS:
            self.fail(codes.too_many(diagnostic.position))

    def _place(self, event: yaml.Event) -> Position:
        start, _ = _marks(event)
        return Position(self.file, start.line + 1, start.column + 1)


def printable(text: str, limit: int = 60) -> str:
    """Text for a message: on one line, of bounded length."""
    flat = "".join(letter if letter.isprintable() else "?" for letter in text)
    return flat if len(flat) <= limit else flat[: limit - 3] + "..."
