"""Text + tree -> text with one value set or removed, everything else unchanged.

These functions only edit characters; `edit.Editor` parses the result to verify it, so an unusual layout leads to a
refused edit, never to a wrong file.
"""

from __future__ import annotations

from meshctl.inventory.tree import MappingNode, Scalar, SequenceNode, Tree
from meshctl.inventory.yaml_text import Value, block, flow, line

# Indentation of new blocks.
_STEP = 2


def replace_value(text: str, old: Tree, value: Value, key: Scalar | None) -> str:
    """Replace `old` in place, in flow style. `key` is the key of `old`, None in a list."""
    end = content_end(text, old)
    if isinstance(old, Scalar) or old.is_flow:
        space = "" if old.start == 0 or text[old.start - 1] in " \n" else " "
        return f"{text[: old.start]}{space}{flow(value)}{text[max(end, old.start) :]}"
    if key is None:
        return f"{text[: old.start]}{flow(value)}{text[end:]}"
    # A block starts below its key: put the new value on the key's line, before its comment.
    colon = _after_colon(text, key)
    return f"{text[:colon]} {flow(value)}{text[colon : _line_end(text, colon)]}{text[end:]}"


def insert_entry(text: str, mapping: MappingNode, key: str, value: Value, *, after: str = "") -> str:
    """Add an entry at the end of `mapping`, or after its entry `after`, in the style of the entry before it."""
    if mapping.is_flow:
        return _insert_into_flow(text, mapping, key, value)
    newline = _newline(text)
    last = after if after in mapping.keys else next(reversed(mapping.keys))
    indent = mapping.keys[last].column - 1
    end = _line_end(text, max(content_end(text, mapping.values[last]), mapping.keys[last].end))
    previous = mapping.values[last]
    is_line = isinstance(previous, MappingNode) and previous.is_flow
    entry = line(key, value, indent) if is_line else block(key, value, indent, _STEP, newline)
    gap = newline if isinstance(previous, MappingNode) and not is_line and _has_gaps(text, mapping) else ""
    return f"{text[:end]}{newline}{gap}{entry}{text[end:]}"


def fill_empty(text: str, old: Tree, indent: int, key: str, value: Value) -> str:
    """Add the first entry of `section:` or `section: {}`, indented by `indent` columns."""
    if isinstance(old, MappingNode) and old.is_flow:
        return _insert_into_flow(text, old, key, value)
    newline = _newline(text)
    start, end = old.start, _line_end(text, old.end)
    kept = text[old.end : end]
    return f"{text[:start].rstrip(' ')}{kept}{newline}{block(key, value, indent, _STEP, newline)}{text[end:]}"


def append_section(text: str, section: str, key: str, value: Value) -> str:
    """Append a section with one entry to the file."""
    newline = _newline(text)
    entry = block(key, value, _STEP, _STEP, newline)
    return f"{text.rstrip()}{newline}{newline}{section}:{newline}{entry}{newline}"


def append_value(text: str, key: str, value: Value) -> str:
    """Append a key to the file."""
    newline = _newline(text)
    return f"{text.rstrip()}{newline}{newline}{block(key, value, 0, _STEP, newline)}{newline}"


def remove_entry(text: str, mapping: MappingNode, key: str) -> str:
    """Remove `key` from `mapping`; comments above the entry stay. The last entry leaves `{}`."""
    written, value = mapping.keys[key], mapping.values[key]
    end = max(content_end(text, value), written.end)
    if mapping.is_flow:
        return _remove_from_flow(text, mapping, written, end)
    if len(mapping.keys) == 1:
        return _empty(text, mapping, written, end)
    start = text.rfind("\n", 0, written.start) + 1
    stop = _next_line(text, end)
    is_apart = _is_blank_before(text, start)
    if stop >= len(text) and is_apart:
        start = text.rfind("\n", 0, start - 1) + 1
    elif _is_blank_at(text, stop) and (is_apart or next(iter(mapping.keys)) == key):
        stop = _next_line(text, stop)
    return text[:start] + text[stop:]


def content_end(text: str, tree: Tree) -> int:
    """The end of a value's last character; the end mark of a block is after comments and blank lines."""
    while isinstance(tree, MappingNode | SequenceNode) and not tree.is_flow:
        if isinstance(tree, MappingNode):
            key = next(reversed(tree.keys))
            below = tree.values[key]
            if isinstance(below, Scalar) and below.start == below.end:
                return _after_colon(text, tree.keys[key])
            tree = below
        else:
            tree = tree.items[-1]
    return len(text[: tree.end].rstrip()) if text[tree.start : tree.end].strip() else tree.end


def _insert_into_flow(text: str, mapping: MappingNode, key: str, value: Value) -> str:
    entry = flow({key: value})[1:-1]
    if not mapping.keys:
        return f"{text[: mapping.start + 1]}{entry}{text[mapping.start + 1 :]}"
    last = next(reversed(mapping.keys))
    end = max(content_end(text, mapping.values[last]), mapping.keys[last].end)
    return f"{text[:end]}, {entry}{text[end:]}"


def _remove_from_flow(text: str, mapping: MappingNode, written: Scalar, end: int) -> str:
    start = written.start
    rest = text[end : mapping.end - 1]
    if rest.lstrip().startswith(","):
        stop = end + rest.index(",") + 1
        stop += len(text[stop : mapping.end - 1]) - len(text[stop : mapping.end - 1].lstrip(" "))
        return text[:start] + text[stop:]
    before = text[mapping.start + 1 : start].rstrip()
    if before.endswith(","):
        start = mapping.start + len(before)
    return text[:start] + text[end:]


def _empty(text: str, mapping: MappingNode, written: Scalar, end: int) -> str:
    """Remove the only entry of a block mapping: write `{}` after the colon of the key above."""
    colon = text.rfind(":", 0, text.rfind("\n", 0, written.start) + 1) + 1
    return f"{text[:colon]} {{}}{text[colon : _line_end(text, colon)]}{text[_line_end(text, end) :]}"


def _has_gaps(text: str, mapping: MappingNode) -> bool:
    """Whether blank lines separate the entries."""
    starts = [key.start for key in mapping.keys.values()]
    return len(starts) > 1 and all(_is_blank_before(text, _block_start(text, start)) for start in starts[1:])


def _block_start(text: str, start: int) -> int:
    """The start of the line at `start`, or of the first comment line right above it."""
    begin = text.rfind("\n", 0, start) + 1
    while begin:
        above = text.rfind("\n", 0, begin - 1) + 1
        if not text[above:begin].lstrip().startswith("#"):
            break
        begin = above
    return begin


def _is_blank_before(text: str, start: int) -> bool:
    above = text.rfind("\n", 0, max(start - 1, 0)) + 1
    return start > 0 and not text[above:start].strip()


def _is_blank_at(text: str, start: int) -> bool:
    return not text[start : _line_end(text, start)].strip()


def _line_end(text: str, at: int) -> int:
    """The offset of the line's end, before the newline."""
    end = text.find("\n", at)
    if end < 0:
        return len(text)
    return end - 1 if text[end - 1] == "\r" and end > at else end


def _next_line(text: str, at: int) -> int:
    """The offset of the next line, or the end of the text."""
    return text.find("\n", at) + 1 or len(text)


def _after_colon(text: str, key: Scalar) -> int:
    """The offset after a key's colon, or after the key if it has none (`? key`)."""
    return text.find(":", key.end) + 1 or key.end


def _newline(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"
