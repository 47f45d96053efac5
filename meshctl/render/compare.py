"""Two fleets -> the differences of each node: render both, compare tree by tree, mask secrets.

No secret is needed: each is replaced by a placeholder derived from its reference. A changed reference shows as a
change; a value that changed in its store does not.
"""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from meshctl import uci
from meshctl.model import Fleet, Secret, SecretRef
from meshctl.render.node import render_fleet
from meshctl.render.rendered import MARKER_PATH, Rendered, RenderedFile


class NodeChange(Enum):
    ADDED = "added"
    REMOVED = "removed"
    CHANGED = "changed"


@dataclass(frozen=True, slots=True)
class FileDifference:
    """One file that differs; `lines` are for display and contain no secret."""

    path: str
    change: NodeChange
    lines: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class NodeDifference:
    """One node that differs; the package lists are packages added to and removed from its image."""

    node: str
    change: NodeChange
    release: tuple[str, str]
    files: tuple[FileDifference, ...] = ()
    packages_added: tuple[str, ...] = ()
    packages_removed: tuple[str, ...] = ()


def compare_fleets(before: Fleet, after: Fleet) -> Iterator[NodeDifference]:
    """The nodes that differ, in the order of `before`, then new ones. Raises InvalidInput from rendering."""
    old = {item.node: item for item in render_fleet(before, placeholder_secret)}
    new = {item.node: item for item in render_fleet(after, placeholder_secret)}
    for name in dict.fromkeys((*old, *new)):
        difference = compare_nodes(old.get(name), new.get(name))
        if difference is not None:
            yield difference


def placeholder_secret(ref: SecretRef) -> Secret:
    """A placeholder for a secret: as long as the longest key, and valid for every kind of key."""
    return Secret(hashlib.sha256(str(ref).encode()).hexdigest())


def compare_nodes(old: Rendered | None, new: Rendered | None) -> NodeDifference | None:
    """The difference of two renderings of a node; None on one side means that it is added or removed."""
    if old is None or new is None:
        present = new or old
        if present is None:
            return None
        change = NodeChange.ADDED if old is None else NodeChange.REMOVED
        release = ("", present.release) if old is None else (present.release, "")
        return NodeDifference(present.node, change, release)
    files = tuple(_files(old, new))
    added = _packages(new) - _packages(old)
    removed = _packages(old) - _packages(new)
    if not files and not added and not removed and old.release == new.release:
        return None
    return NodeDifference(
        node=new.node,
        change=NodeChange.CHANGED,
        release=(old.release, new.release),
        files=files,
        packages_added=tuple(sorted(added)),
        packages_removed=tuple(sorted(removed)),
    )


def _packages(rendered: Rendered) -> frozenset[str]:
    return frozenset((*rendered.packages, *(f"-{name}" for name in rendered.removed_packages)))


def _files(old: Rendered, new: Rendered) -> Iterator[FileDifference]:
    before = {file.path: file for file in old.files}
    after = {file.path: file for file in new.files}
    for path in sorted(before.keys() | after.keys()):
        # the marker changes exactly if another file changes
        if path == MARKER_PATH:
            continue
        left, right = before.get(path), after.get(path)
        if left is None or right is None:
            change = NodeChange.ADDED if left is None else NodeChange.REMOVED
            yield FileDifference(path, change, tuple(compare_files(left, right)))
        elif (left.content, left.mode) != (right.content, right.mode):
            yield FileDifference(path, NodeChange.CHANGED, tuple(compare_files(left, right)))


def compare_files(old: RenderedFile | None, new: RenderedFile | None) -> Iterator[str]:
    """The difference of two versions of a file in lines for display, without secrets."""
    if old is not None and new is not None and old.mode != new.mode:
        yield f"mode {old.mode:04o} -> {new.mode:04o}"
    left, right = _package(old, new), _package(new, old)
    if left is not None and right is not None:
        yield from (_masked(line, old, new) for line in uci.diff(left, right).lines())
        return
    old_text, new_text = (file.masked if file is not None else "" for file in (old, new))
    if old is not None and new is not None and old_text == new_text and old.content != new.content:
        yield "~ a secret"
    lines = difflib.unified_diff(old_text.splitlines(), new_text.splitlines(), lineterm="", n=1)
    # the first two lines are the file names
    yield from list(lines)[2:]


def _masked(line: str, *files: RenderedFile | None) -> str:
    """The line with the secrets of both versions masked, in options of any name."""
    for file in files:
        line = file.hide(line) if file is not None else line
    return line


def _package(file: RenderedFile | None, other: RenderedFile | None) -> uci.Package | None:
    """The file's tree; an empty one if only the other side is UCI."""
    if file is not None:
        return file.package
    if other is not None and other.package is not None:
        return uci.Package(other.package.name)
    return None
