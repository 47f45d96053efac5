"""Entries -> the text of a new inventory, or the edits of an existing one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from meshctl.diagnostics import InvalidInput
from meshctl.inventory.edit import Editor, FileEdit
from meshctl.inventory.load import load
from meshctl.inventory.yaml_text import Value, flow, line
from meshctl.model import Fleet

Entry = tuple[str, ...]
# lines up to here stay on one line
_WIDTH = 100
HEADER = "# Made by `meshctl inventory import` from {source}.\n"


def new_text(values: Mapping[Entry, Value], source: str, comments: tuple[str, ...] = ()) -> str:
    """The YAML of a new inventory with these entries; `comments` are lines below its header."""
    tree: dict[str, object] = {}
    for path, value in values.items():
        place = tree
        for key in path[:-1]:
            inner = place.setdefault(key, {})
            assert isinstance(inner, dict)
            place = inner
        place[path[-1]] = value
    # a device's own name may contain a line break
    lines = [HEADER.format(source=" ".join(source.split())), *(f"# {' '.join(each.split())}\n" for each in comments)]
    order = ("meshctl", "fleet", "country", "operators", "system", "meshes", "hardware", "nodes", "robots")
    for key in sorted(tree, key=order.index):
        block = _block(key, tree[key], 0)
        lines.append(("\n" if len(block) > 1 else "") + "".join(f"{text}\n" for text in block))
    return "".join(lines)


def _block(key: str, value: object, indent: int) -> list[str]:
    """`key: value`: lists and short mappings of single values on one line, others below their key."""
    assert isinstance(value, str | int | float | bool | list | Mapping) or value is None
    single = line(key, value, indent)
    is_long = len(single) > _WIDTH or (indent == 0 and bool(value))
    if isinstance(value, Mapping) and (is_long or any(isinstance(item, Mapping) for item in value.values())):
        head = line(key, "", indent).removesuffix(' ""')
        return [head, *(text for name, item in value.items() for text in _block(name, item, indent + 2))]
    if isinstance(value, list) and len(single) > _WIDTH:
        head = line(key, "", indent).removesuffix(' ""')
        return [head, *(f"{' ' * (indent + 2)}- {flow(item)}" for item in value)]
    return [single]


def load_text(path: Path, text: str) -> Fleet:
    """The fleet of a new inventory at `path`, before it is written. Raises InvalidInput."""
    loaded = load(path, read=lambda _: text.encode())
    if loaded.fleet is None:
        raise InvalidInput(loaded.diagnostics)
    return loaded.fleet


def edited(
    inventory: Path, environ: Mapping[str, str], values: Mapping[Entry, Value], nodes_file: Path | None = None
) -> Editor:
    """An editor of the existing inventory with the entries set, new nodes in `nodes_file`. Raises InputError if its
    layout does not allow it."""
    editor = Editor.open(inventory, environ=environ)
    editor.new_nodes_file = nodes_file
    for path, value in values.items():
        after = editor.sibling_of(path[1]) if path[0] == "nodes" else ""
        editor.set(path, value, after=after)
    return editor


def edits_of(
    inventory: Path, environ: Mapping[str, str], values: Mapping[Entry, Value], nodes_file: Path | None = None
) -> tuple[FileEdit, ...]:
    """The edits of the inventory's files. Raises InvalidInput if the inventory would have errors."""
    return edited(inventory, environ, values, nodes_file).changes()
