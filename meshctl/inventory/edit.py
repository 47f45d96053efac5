"""Edit an inventory and keep its comments and layout.

Flow: `Editor.open` -> `set` and `remove` -> `changes` -> `save`. After each edit the text is parsed again and must
contain exactly the intended data, and the whole inventory must still load; otherwise the edit is refused and nothing is
written.
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Mapping, Sequence
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
from meshctl.inventory.yaml_text import Value, is_bare, parsed_data
from meshctl.model import Fleet, NodeState

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
    """The texts of an inventory's files during an edit; create it with `Editor.open`."""

    path: Path
    environ: Mapping[str, str]
    new_nodes_file: Path | None = None
    """The file that gets entries of new nodes; by default the first one that has nodes."""
    _before: dict[Path, str] = field(default_factory=dict)
    _texts: dict[Path, str] = field(default_factory=dict)
    _roots: dict[Path, MappingNode] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path, *, environ: Mapping[str, str] = MappingProxyType({})) -> Editor:
        """Raises InvalidInput if the inventory has errors, which must be fixed by hand first."""
        loaded = load(path, environ=environ)
        if loaded.fleet is None:
            raise InvalidInput(loaded.diagnostics)
        editor = cls(path, environ)
        for file in read_files(path, environ).files:
            text = editor._before[file] = editor._texts[file] = read_bytes(file).decode("utf-8")
            root = _compose(file, text.removeprefix(_BOM))
            if root is None:
                raise InputError(f"{file}: changed while it was being read")
            editor._roots[file] = root
        return editor

    def set(self, path: tuple[str, ...], value: Value, *, after: str = "") -> None:
        """Set `path` to `value`, in the file that has it or its nearest container; a new entry goes to the end of its
        mapping, or after the entry `after`. Raises InputError if the layout does not allow it."""
        file = self._file_of(path)
        root = self._roots[file]
        self._replace(
            file,
            _with_value(plain_data(root), path, parsed_data(value)),
            self._set_text(file, self._text(file), path, value, after),
        )

    def set_nodes(self, values: Mapping[str, Mapping[str, Value]]) -> None:
        """Set values of many nodes, as `set_node` does of one. A file is parsed once for each key and not for each
        node, so that the time grows with the nodes and not with their square."""
        texts, roots = dict(self._texts), dict(self._roots)
        try:
            self._set_nodes_at_once(values)
        except InputError:
            # one at a time may work nevertheless: another order, and a file that is parsed after each
            self._texts, self._roots = texts, roots
            for node, fields in values.items():
                set_node(self, node, fields)

    def _set_nodes_at_once(self, values: Mapping[str, Mapping[str, Value]]) -> None:
        is_known = {node: self.has(("nodes", node)) for node in values}
        known = [node for node in values if is_known[node]]
        added = [node for node in values if not is_known[node]]
        while added and not self._has_entries_beside(added[0]):
            first = added.pop(0)
            set_node(self, first, values[first])
        ranges = self._ranges()
        self._set_each([(("nodes", node), dict(values[node]), _last_of(ranges, node)) for node in added])
        for key in dict.fromkeys(key for node in known for key in values[node]):
            self._set_each([(("nodes", node, key), values[node][key], "") for node in known if key in values[node]])

    def remove(self, path: tuple[str, ...]) -> None:
        """Remove the entry at `path`. Raises InputError if there is none, or the layout does not allow it."""
        file = self._file_of(path)
        root = self._roots[file]
        mapping = descend(root, path[:-1])
        if not isinstance(mapping, MappingNode) or path[-1] not in mapping.keys:
            raise InputError(f"{file}: no entry {'.'.join(path)} to remove")
        text = remove_entry(self._text(file), mapping, path[-1])
        self._replace(file, _without_key(plain_data(root), path), text)

    def changes(self) -> tuple[FileEdit, ...]:
        """The edits of each changed file. Raises InvalidInput if the edited inventory does not load."""
        self.fleet()
        return tuple(
            FileEdit(file, self._before[file], text) for file, text in self._texts.items() if text != self._before[file]
        )

    def fleet(self) -> Fleet:
        """The fleet of the edited inventory, before it is saved. Raises InvalidInput if it does not load."""
        loaded = load(self.path, environ=self.environ, read=self._read)
        if loaded.fleet is None:
            raise InvalidInput(loaded.diagnostics)
        return loaded.fleet

    def has(self, path: tuple[str, ...]) -> bool:
        """Whether a file sets `path`."""
        return any(descend(self._roots[file], path) is not None for file in self._texts)

    def files_with_nodes(self) -> tuple[Path, ...]:
        """The files that have a section `nodes`, in the order in which they are read."""
        return tuple(file for file in self._texts if "nodes" in self._roots[file].values)

    def files(self) -> tuple[Path, ...]:
        """All files of the inventory, in the order in which they are read."""
        return tuple(self._texts)

    def sibling_of(self, node: str) -> str:
        """The entry after which `node`'s own entry belongs: the range that contains it, or the last entry of a node of
        that range right below it; an empty string if no range contains it."""
        return _last_of(self._ranges(), node)

    def _ranges(self) -> list[tuple[frozenset[str], str]]:
        """The names of each range, and the entry after which an own entry of one of them belongs."""
        found = []
        for root in self._roots.values():
            nodes = root.values.get("nodes")
            patterns = list(nodes.keys) if isinstance(nodes, MappingNode) else []
            for number, pattern in enumerate(patterns):
                if is_range(pattern):
                    names = frozenset(_names(pattern))
                    own = takewhile(names.__contains__, patterns[number + 1 :])
                    found.append((names, [pattern, *own][-1]))
        return found

    def _has_range_of(self, file: Path, node: str) -> bool:
        nodes = self._roots[file].values.get("nodes")
        patterns = nodes.keys if isinstance(nodes, MappingNode) else {}
        return any(is_range(pattern) and node in _names(pattern) for pattern in patterns)

    def _has_entries_beside(self, node: str) -> bool:
        """Whether the file that gets the entry of this new node has entries of others."""
        nodes = descend(self._roots[self._file_of(("nodes", node))], ("nodes",))
        return isinstance(nodes, MappingNode) and bool(nodes.keys)

    def _set_each(self, edits: Sequence[tuple[tuple[str, ...], Value, str]]) -> None:
        """Set each path, in an entry of its own below `nodes`, or in a new one after the entry that is given."""
        for file in self._texts:
            root = self._roots[file]
            here = [each for each in edits if self._file_of(each[0]) == file]
            nodes = root.values.get("nodes")
            if not here or not isinstance(nodes, MappingNode):
                continue
            number = {name: place for place, name in enumerate(nodes.keys)}
            end = len(number) - 1
            ordered = sorted(here, key=lambda each: number.get(each[2], number.get(each[0][1], end)))
            text, meant = self._text(file), plain_data(root)
            # from the last entry to the first: the positions of those before it stay true
            for path, value, after in reversed(ordered):
                meant = _with_value(meant, path, parsed_data(value))
                text = self._set_text(file, text, path, value, after)
            self._replace(file, meant, text)

    def _read(self, path: Path) -> bytes:
        text = self._texts.get(path)
        return read_bytes(path) if text is None else text.encode("utf-8")

    def _text(self, file: Path) -> str:
        return self._texts[file].removeprefix(_BOM)

    def _file_of(self, path: tuple[str, ...]) -> Path:
        """The file that sets `path` or its longest prefix; the first file if none does. The own entry of a node of a
        range belongs into the range's file."""
        if len(path) > 1 and path[0] == "nodes" and not self.has(path[:2]):
            with_range = next((file for file in self._texts if self._has_range_of(file, path[1])), None)
            if (file := with_range or self.new_nodes_file) is not None:
                return file

        def depth(file: Path) -> int:
            root = self._roots[file]
            return max(end for end in range(len(path) + 1) if descend(root, path[:end]) is not None)

        return max(self._texts, key=depth)

    def _set_text(self, file: Path, text: str, path: tuple[str, ...], value: Value, after: str) -> str:
        root = self._roots[file]
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
            raise InputError(f"{file}: {'.'.join(path[:known])} is not a mapping, so {key} cannot be set")
        return insert_entry(text, container, key, value, after=after)

    def _replace(self, file: Path, meant: object, text: str) -> None:
        """Replace `file` by `text` if it contains the intended data."""
        root = _compose(file, text)
        if root is None or not _equal_data(plain_data(root), meant):
            raise InputError(
                f"{file}: the layout does not allow this edit without changing other values",
                hint="edit the file by hand, or simplify the layout of the entry first",
            )
        bom = _BOM if self._texts[file].startswith(_BOM) else ""
        self._texts[file], self._roots[file] = bom + text, root


def set_node(editor: Editor, node: str, values: Mapping[str, Value]) -> None:
    """Set values of one node. A node of a range gets its own entry, after the range."""
    if not editor.has(("nodes", node)):
        editor.set(("nodes", node), dict(values), after=editor.sibling_of(node))
        return
    for key, value in values.items():
        editor.set(("nodes", node, key), value)


def _last_of(ranges: Sequence[tuple[frozenset[str], str]], node: str) -> str:
    return next((last for names, last in ranges if node in names), "")


def set_state(editor: Editor, node: str, state: NodeState) -> None:
    """Set a node's state."""
    set_node(editor, node, {"state": state.value})


def add_topic(editor: Editor, name: str, fields: Mapping[str, Value]) -> None:
    """Add a topic with `fields` by the format's keys (`priority`, `class`, ...). Raises InputError if it exists."""
    if editor.has(("topics", name)):
        raise InputError(f"topic '{name}' already exists", hint="change it with `set`")
    editor.set(("topics", name), dict(fields))


def set_topic(editor: Editor, name: str, fields: Mapping[str, Value]) -> None:
    """Change keys of a topic. Raises InputError if it does not exist."""
    if not editor.has(("topics", name)):
        raise InputError(f"there is no topic '{name}'", hint="create it with `add`")
    for key, value in fields.items():
        editor.set(("topics", name, key), value)


def remove_topic(editor: Editor, name: str) -> None:
    """Remove a topic. Raises InputError if it does not exist."""
    editor.remove(("topics", name))


def save(changes: tuple[FileEdit, ...]) -> None:
    """Write each file atomically, keeping its mode. Raises InputError if a file changed meanwhile or cannot be
    written."""
    for change in changes:
        target = Path(os.path.realpath(change.file))
        try:
            if target.read_bytes() != change.before.encode("utf-8"):
                raise InputError(f"{change.file}: changed meanwhile; not written")
            _write(target, change.after.encode("utf-8"))
        except OSError as reason:
            raise InputError(f"{change.file}: cannot be written: {reason.strerror}") from reason


def _write(target: Path, content: bytes) -> None:
    """Write a temporary file and rename it, so that a crash leaves either the old or the new text."""
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
    """Append a top-level key: a section's entries below it, other values on the same line."""
    match value:
        case Mapping() if len(value) == 1:
            ((name, item),) = value.items()
            return append_section(text, key, name, item)
        case _:
            return append_value(text, key, value)


def _with_value(old: object, path: tuple[str, ...], value: object) -> object:
    """`old` with `value` at `path`; missing containers are created."""
    if not path:
        return value
    if isinstance(old, list):
        return [
            _with_value(item, path[1:], value) if str(number) == path[0] else item for number, item in enumerate(old)
        ]
    mapping = old if isinstance(old, dict) else {}
    return {**mapping, path[0]: _with_value(mapping.get(path[0]), path[1:], value)}


def _without_key(old: object, path: tuple[str, ...]) -> object:
    if not isinstance(old, dict):
        return old
    if len(path) == 1:
        return {key: item for key, item in old.items() if key != path[0]}
    return {key: _without_key(item, path[1:]) if key == path[0] else item for key, item in old.items()}


def _equal_data(left: object, right: object) -> bool:
    """Whether two values are equal, ignoring key order; text that could be a number must be quoted in both."""
    match left, right:
        case dict(), dict():
            return left.keys() == right.keys() and all(_equal_data(left[key], right[key]) for key in left)
        case list(), list():
            return len(left) == len(right) and all(map(_equal_data, left, right))
        case str(), str():
            return left == right and (isinstance(left, Plain) == isinstance(right, Plain) or is_bare(left))
        case _:
            return left is None and right is None
