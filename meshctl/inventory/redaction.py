"""Redact source lines in findings: show only values with a known key that is not secret.

Everyone with access to the CI log can read these lines. A line may belong to a file that is not an inventory (an
included file of secrets), or contain a key in place of a reference, or a misspelled key. So a value is shown only if
the format knows its key; the rest becomes `***`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel

from meshctl.inventory.addresses import AddressRule
from meshctl.inventory.compose import compose
from meshctl.inventory.documents import InventoryDocument, SecretDocument
from meshctl.inventory.source import Source
from meshctl.inventory.tree import MappingNode, Scalar, SequenceNode, Tree
from meshctl.inventory.validate import model_of, step_into
from meshctl.uci import is_secret_option

HIDDEN = "***"
# larger texts are not parsed again for an excerpt
_MAX_CHARACTERS = 2_000_000
_SECRET_WORDS = re.compile(r"(key|psk|pass(word|phrase)?|secret|token|credentials?)s?", re.IGNORECASE)
_VARIABLE = re.compile(r"[A-Z_][A-Z0-9_]*")
# a comment that may contain a secret: an assignment to such a word, or text as long as a key
_SUSPICIOUS_COMMENT = re.compile(rf"({_SECRET_WORDS.pattern})\s*[:=]|[A-Za-z0-9+/_=-]{{20,}}", re.IGNORECASE)
_WORD = re.compile(r"[^\s\[\]{},:#\"'&*|>-]+")
_MAX_KEY_CHARACTERS = 40
# a key where YAML allows one: at the start of a line or an item, or in a flow mapping
_KEY = re.compile(r"(?:^[ -]*|[{,][ ]*)(<<|[A-Za-z_]+)(?=[ ]*:(?:\s|$))", re.MULTILINE)
# an anchor or alias where YAML allows one: after a space or an indicator
_ANCHOR = re.compile(r"(?:^|(?<=[\s\[{,]))([&*])([^\s\[\]{},]+)", re.MULTILINE)


class _Visibility(IntEnum):
    UNKNOWN = 0
    SHOWN = 1
    HIDDEN = 2


@dataclass(slots=True)
class Excerpts:
    """The redacted lines of one file."""

    text: str
    _marks: bytearray | None = field(default=None, repr=False)
    _starts: list[int] = field(default_factory=list, repr=False)
    _is_inventory: bool = False

    def line(self, number: int, column: int) -> tuple[str, int] | None:
        """The redacted line `number` (from 1), and the new position of `column`; None if there is no such line.

        A column of 0 stays 0.
        """
        if self._marks is None:
            self._read()
        assert self._marks is not None
        if not 1 <= number <= len(self._starts) - 1:
            return None
        start, end = self._starts[number - 1], self._starts[number] - 1
        line = self.text[start:end].rstrip()
        return _masked(line, self._marks[start : start + len(line)], column, self._is_inventory)

    def _read(self) -> None:
        self.text = self.text.removeprefix("\ufeff")
        self._marks = bytearray(len(self.text))
        # as editors and PyYAML count lines; str.splitlines also splits at form feeds
        self._starts = [0]
        for part in self.text.split("\n"):
            self._starts.append(self._starts[-1] + len(part) + 1)
        composed = compose(Source("", self.text)) if len(self.text) <= _MAX_CHARACTERS else None
        root = composed.root if composed is not None else None
        if isinstance(root, MappingNode):
            known = _keys_of(InventoryDocument)
            self._is_inventory = all(key in known for key in root.keys)
            for start, end, mark in sorted(_spans(root, InventoryDocument), key=lambda span: span[2]):
                self._marks[start:end] = bytes([mark]) * (min(end, len(self._marks)) - start)
            self._show_anchors(self._marks)
            self._show_refused_keys(self._marks)
        else:
            for found in re.finditer(r"([A-Za-z_]+)[\"']?\s*:(?=\s|$)", self.text):
                if found[1] in _all_keys():
                    self._marks[found.start(1) : found.end(1)] = bytes([_Visibility.SHOWN]) * len(found[1])

    def _show_refused_keys(self, marks: bytearray) -> None:
        """Show keys that are no part of the tree: of merges, and known ones that are written twice."""
        for found in _KEY.finditer(self.text):
            if (found[1] == "<<" or found[1] in _all_keys()) and not any(marks[found.start(1) : found.end(1)]):
                marks[found.start(1) : found.end(1)] = bytes([_Visibility.SHOWN]) * len(found[1])

    def _show_anchors(self, marks: bytearray) -> None:
        """Show the names that are both defined and used. Another `&word` may be a secret that was not quoted."""
        found = [anchor for anchor in _ANCHOR.finditer(self.text) if marks[anchor.start()] != _Visibility.HIDDEN]
        defined, used = ({anchor[2] for anchor in found if anchor[1] == mark} for mark in "&*")
        for anchor in found:
            if anchor[2] in defined & used:
                marks[anchor.start() : anchor.end()] = bytes([_Visibility.SHOWN]) * len(anchor[0])


def _spans(tree: Tree, kind: Any) -> Iterator[tuple[int, int, _Visibility]]:
    """The spans of keys and values, and whether they are shown."""
    kind = _fitting(kind, tree)
    model = model_of(kind)
    match tree:
        case Scalar():
            # hide a value in place of a mapping, such as a key in place of its reference
            is_shown = kind is not None and model is None
            yield tree.start, tree.end, _Visibility.SHOWN if is_shown else _Visibility.HIDDEN
        case SequenceNode():
            for number, item in enumerate(tree.items):
                yield from _spans(item, step_into(kind, number) if kind is not None and model is None else None)
        case MappingNode():
            for key, value in tree.values.items():
                word = tree.keys[key]
                is_known = kind is not None and (model is None or key in _keys_of(model))
                is_name = is_known or (len(key) <= _MAX_KEY_CHARACTERS and _WORD.fullmatch(key) is not None)
                yield word.start, word.end, _Visibility.SHOWN if is_name else _Visibility.HIDDEN
                below = step_into(kind, key) if is_known else None
                yield from _spans(value, None if _is_secret(key, value, below, model) else below)


def _fitting(kind: Any, tree: Tree) -> Any:
    """The alternative of a union type (`address: 10.42.0.1` or `{from: ...}`) that matches the tree."""
    if get_origin(kind) is Annotated:
        return _fitting(get_args(kind)[0], tree)
    if kind is AddressRule:
        # parsed by parse_address
        return dict[str, str]
    if get_origin(kind) not in (Union, UnionType):
        return kind
    kinds = [_fitting(argument, tree) for argument in get_args(kind) if argument is not NoneType]
    wanted = [candidate for candidate in kinds if _is_mapping(candidate) == isinstance(tree, MappingNode)]
    return (wanted or kinds)[0]


def _is_mapping(kind: Any) -> bool:
    return model_of(kind) is not None or get_origin(kind) is dict


def _is_secret(key: str, value: Tree, below: Any, model: type[BaseModel] | None) -> bool:
    """Whether a value with a known key is hidden."""
    if model is SecretDocument:
        # names of variables and entries are not secret
        return key == "env" and not (isinstance(value, Scalar) and _VARIABLE.fullmatch(value.text))
    last = key.rpartition(".")[2]
    is_reference = SecretDocument in (model_of(below), model_of(step_into(below, 0)) if below is not None else None)
    return not is_reference and model is None and (is_secret_option(last) or _SECRET_WORDS.fullmatch(last) is not None)


def _masked(line: str, marks: bytearray, column: int, is_inventory: bool) -> tuple[str, int]:
    """The masked line, and the new column."""
    hash_at = _comment(line, marks)
    for found in _WORD.finditer(line, 0, hash_at):
        for at in range(*found.span()):
            if marks[at] == _Visibility.UNKNOWN:
                marks[at] = _Visibility.HIDDEN
    is_clear = _Visibility.HIDDEN not in marks[:hash_at]
    if hash_at < len(line) and not (is_clear and is_inventory and not _SUSPICIOUS_COMMENT.search(line[hash_at:])):
        marks[hash_at + 1 :] = bytes([_Visibility.HIDDEN]) * (len(line) - hash_at - 1)
    shown: list[str] = []
    caret = 0
    for at, letter in enumerate(line):
        if at + 1 == column:
            caret = sum(map(len, shown)) + 1
        if marks[at] != _Visibility.HIDDEN:
            shown.append(letter)
        elif not at or marks[at - 1] != _Visibility.HIDDEN:
            shown.append(HIDDEN)
        elif at + 1 == column:
            # the column is in hidden text
            caret -= len(HIDDEN)
    text = "".join(shown)
    return text, (caret or len(text) + 1) if column else 0


def _comment(line: str, marks: bytearray) -> int:
    """The start of the line's comment; the length of the line if there is none."""
    for found in re.finditer(r"(?:^|(?<=\s))#", line):
        if marks[found.start()] == _Visibility.UNKNOWN:
            return found.start()
    return len(line)


@cache
def _keys_of(model: type[BaseModel]) -> frozenset[str]:
    return frozenset(field.alias or name for name, field in model.model_fields.items())


@cache
def _all_keys() -> frozenset[str]:
    found: set[str] = set()
    waiting: list[Any] = [InventoryDocument]
    seen: set[Any] = set()
    while waiting:
        kind = waiting.pop()
        model = model_of(kind)
        if model is None:
            waiting.extend(get_args(kind))
        elif model not in seen:
            seen.add(model)
            found |= _keys_of(model)
            waiting.extend(field.annotation for field in model.model_fields.values())
    return frozenset(found)
