"""Edits of an inventory that keep its comments and layout.

Open an inventory, set and remove values, ask for the changes, save them. After each step the text is read again and
must say exactly what was meant, and the whole inventory must still load: a step that does not is refused, and nothing
is written.
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import unified_diff
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType

from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.inventory.compose import compose
from meshctl.inventory.include import read_files
from meshctl.inventory.load import load
from meshctl.inventory.ranges import BadRange, expand, is_range
from meshctl.inventory.source import Source, read_bytes
from meshctl.inventory.text_edit import (
    append_section,
    append_value,
    fill_empty,
    insert_entry,
    remove_entry,
    replace_value,
)
from meshctl.inventory.tree import MappingNode, Plain, Scalar, descend, plain_data
from meshctl.inventory.yaml_text import Value, data, is_bare
from meshctl.model import NodeState

_BOM = "\ufeff"


@dataclass(frozen=True, slots=True)
class FileEdit:
    """One file's text before and after."""

    file: Path
    before: str
    after: str

    def diff(self) -> str:
        """A unified diff."""
        lines = unified_diff(
            self.before.splitlines(keepends=True),
            self.after.splitlines(keepends=True),
            str(self.file),
            str(self.file),
        )
        return "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)


@dataclass(slots=True)
class Editor:
    """The texts of an inventory's files while they are edited. Open one with `Editor.open`."""

    path: Path
    environ: Mapping[str, str]
    _before: dict[Path, str] = field(default_factory=dict)
    _texts: dict[Path, str] = field(default_factory=dict)
    _roots: dict[Path, MappingNode] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path, *, environ: Mapping[str, str] = MappingProxyType({})) -> Editor:
        """Raises InvalidInput when the inventory has errors: they are mended first, by hand."""
        loaded = load(path, environ=environ)
        if loaded.fleet is None:
            raise InvalidInput(loaded.diagnostics)
        editor = cls(path, environ)
        for file in read_files(path, environ).files:
            text = editor._before[file] = editor._texts[file] = read_bytes(file).decode("utf-8")
            root = _compose(file, text.removeprefix(_BOM))
            if root is None:
                raise InputError(f"{file}: has changed while it was read")
            editor._roots[file] = root
        return editor

    def set(self, path: tuple[str, ...], value: Value, *, after: str = "") -> None:
        """Write `value` at `path`, in the file that has it or its nearest container; a new entry goes to the end of
        its mapping, or behind the entry `after`. Raises InputError when the layout does not allow it."""
        file = self._file_of(path)
        root = self._roots[file]
        self._replace(file, _with(plain_data(root), path, data(value)), self._set_text(file, root, path, value, after))

    def remove(self, path: tuple[str, ...]) -> None:
        """Take the entry at `path` out. Raises InputError when there is none, or the layout does not allow it."""
        file = self._file_of(path)
        root = self._roots[file]
        mapping = descend(root, path[:-1])
        if not isinstance(mapping, MappingNode) or path[-1] not in mapping.keys:
            raise InputError(f"{file}: there is no {'.'.join(path)} to remove")
        text = remove_entry(self._text(file), mapping, path[-1])
        self._replace(file, _without(plain_data(root), path), text)

    def changes(self) -> tuple[FileEdit, ...]:
        """The files that differ. Raises InvalidInput when the edited inventory would not load."""
        loaded = load(self.path, environ=self.environ, read=self._read)
        if loaded.fleet is None:
            raise InvalidInput(loaded.diagnostics)
        return tuple(
            FileEdit(file, self._before[file], text) for file, text in self._texts.items() if text != self._before[file]
        )

    def has(self, path: tuple[str, ...]) -> bool:
        """Whether a file writes `path`."""
        return any(descend(self._roots[file], path) is not None for file in self._texts)

    def sibling_of(self, node: str) -> str:
        """The entry that `node`'s own belongs behind: the range that makes it, or the last of its nodes' own entries
        right below the range; the empty text when no range makes it."""
        for file in self._texts:
            nodes = self._roots[file].values.get("nodes")
            patterns = list(nodes.keys) if isinstance(nodes, MappingNode) else []
            for number, pattern in enumerate(patterns):
                names = set(_names(pattern)) if is_range(pattern) else set()
                if node in names:
                    own = takewhile(names.__contains__, patterns[number + 1 :])
                    return [pattern, *own][-1]
        return ""

    def _read(self, path: Path) -> bytes:
        text = self._texts.get(path)
        return read_bytes(path) if text is None else text.encode("utf-8")

    def _text(self, file: Path) -> str:
        return self._texts[file].removeprefix(_BOM)

    def _file_of(self, path: tuple[str, ...]) -> Path:
        """The file that writes `path`, or the longest part of it; the first file when none does."""

        def depth(file: Path) -> int:
            root = self._roots[file]
            return max(end for end in range(len(path) + 1) if descend(root, path[:end]) is not None)

        return max(self._texts, key=depth)

    def _set_text(self, file: Path, root: MappingNode, path: tuple[str, ...], value: Value, after: str) -> str:
        text = self._text(file)
        old = descend(root, path)
        if old is not None:
            parent = descend(root, path[:-1])
            key_node = parent.keys[path[-1]] if isinstance(parent, MappingNode) else None
            return replace_value(text, old, value, key_node)
        known = max(end for end in range(len(path)) if descend(root, path[:end]) is not None)
        key = path[known]
        for name in reversed(path[known + 1 :]):
            value = {name: value}
        if known == 0:
            return _append(text, key, value)
        container = descend(root, path[:known])
        is_empty = (isinstance(container, Scalar) and container.is_null) or (
            isinstance(container, MappingNode) and not container.keys
        )
        if container is not None and is_empty:
            parent = descend(root, path[: known - 1])
            assert isinstance(parent, MappingNode)
            return fill_empty(text, container, parent.keys[path[known - 1]].column + 1, key, value)
        if not isinstance(container, MappingNode):
            raise InputError(f"{file}: {'.'.join(path[:known])} is no mapping, so {key} cannot be set in it")
        return insert_entry(text, container, key, value, after=after)

    def _replace(self, file: Path, meant: object, text: str) -> None:
        """Take `text` for `file` when it says what is meant."""
        root = _compose(file, text)
        if root is None or not _same(plain_data(root), meant):
            raise InputError(
                f"{file}: the layout does not allow this edit without touching more than it",
                hint="make the edit by hand, or write the entry in a simpler layout first",
            )
        bom = _BOM if self._texts[file].startswith(_BOM) else ""
        self._texts[file], self._roots[file] = bom + text, root


def set_node(editor: Editor, node: str, values: Mapping[str, Value]) -> None:
    """Write values at one node. A node that a range makes gets an entry of its own, behind the range."""
    if not editor.has(("nodes", node)):
        editor.set(("nodes", node), dict(values), after=editor.sibling_of(node))
        return
    for key, value in values.items():
        editor.set(("nodes", node, key), value)


def set_state(editor: Editor, node: str, state: NodeState) -> None:
    """Write a node's state."""
    set_node(editor, node, {"state": state.value})


def add_topic(editor: Editor, name: str, fields: Mapping[str, Value]) -> None:
    """A new topic, `fields` by the keys of the format (`priority`, `class`, ...). Raises InputError when it exists."""
    if editor.has(("topics", name)):
        raise InputError(f"there is a topic '{name}' already", hint="change it with `set`")
    editor.set(("topics", name), dict(fields))


def set_topic(editor: Editor, name: str, fields: Mapping[str, Value]) -> None:
    """Change keys of a topic. Raises InputError when there is none."""
    if not editor.has(("topics", name)):
        raise InputError(f"there is no topic '{name}'", hint="make it with `add`")
    for key, value in fields.items():
        editor.set(("topics", name, key), value)


def remove_topic(editor: Editor, name: str) -> None:
    """Take a topic out. Raises InputError when there is none."""
    editor.remove(("topics", name))


def save(changes: tuple[FileEdit, ...]) -> None:
    """Write each file at once, keeping its mode. Raises InputError when one has changed meanwhile, or cannot be
    written."""
    for change in changes:
        target = Path(os.path.realpath(change.file))
        try:
            if target.read_bytes() != change.before.encode("utf-8"):
                raise InputError(f"{change.file}: has changed meanwhile, so nothing was written to it")
            _write(target, change.after.encode("utf-8"))
        except OSError as reason:
            raise InputError(f"{change.file}: cannot be written: {reason.strerror}") from reason


def _write(target: Path, content: bytes) -> None:
    """Through a file beside it, so that a crash leaves the old text or the new one."""
    mode = stat.S_IMODE(target.stat().st_mode)
    descriptor, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(name, mode)
        os.replace(name, target)
    except OSError:
        Path(name).unlink(missing_ok=True)
        raise


def _compose(file: Path, text: str) -> MappingNode | None:
    composed = compose(Source(str(file), text))
    return composed.root if isinstance(composed.root, MappingNode) and not composed.diagnostics else None


def _names(pattern: str) -> tuple[str, ...]:
    try:
        return expand(pattern)
    except BadRange:
        return ()


def _append(text: str, key: str, value: Value) -> str:
    """A new top-level key: entries of a section below it, anything else on its line."""
    match value:
        case Mapping() if len(value) == 1:
            ((name, item),) = value.items()
            return append_section(text, key, name, item)
        case _:
            return append_value(text, key, value)


def _with(old: object, path: tuple[str, ...], value: object) -> object:
    """`old` with `value` at `path`; containers that are missing on the way are made."""
    if not path:
        return value
    if isinstance(old, list):
        return [_with(item, path[1:], value) if str(number) == path[0] else item for number, item in enumerate(old)]
    mapping = old if isinstance(old, dict) else {}
    return {**mapping, path[0]: _with(mapping.get(path[0]), path[1:], value)}


def _without(old: object, path: tuple[str, ...]) -> object:
    if not isinstance(old, dict):
        return old
    if len(path) == 1:
        return {key: item for key, item in old.items() if key != path[0]}
    return {key: _without(item, path[1:]) if key == path[0] else item for key, item in old.items()}


def _same(one: object, other: object) -> bool:
    """Equal values in the same order of keys or any other; text that could be a number must be quoted in both."""
    match one, other:
        case dict(), dict():
            return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
        case list(), list():
            return len(one) == len(other) and all(map(_same, one, other))
        case str(), str():
            return one == other and (isinstance(one, Plain) == isinstance(other, Plain) or is_bare(one))
        case _:
            return one is None and other is None
