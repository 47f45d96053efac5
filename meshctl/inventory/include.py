"""The inventory's files -> one tree: the first file and its includes; each key may be set only once."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from meshctl.diagnostics import Diagnostic, Position
from meshctl.file_access import HINT, Boundary
from meshctl.inventory import codes
from meshctl.inventory.compose import MAX_VALUES, compose
from meshctl.inventory.source import Reader, Source, read_bytes, read_source
from meshctl.inventory.tree import MappingNode, Scalar, SequenceNode, Tree, describe, position

# Number of files including all includes; bounds the time that a crafted inventory can cost.
MAX_FILES = 256
# The first file of a directory.
FIRST_FILE = "fleet.yaml"


@dataclass(frozen=True, slots=True)
class MergedFiles:
    """`root` is None if a file could not be read as a mapping. `files` are in the order of reading."""

    root: MappingNode | None
    files: tuple[Path, ...]
    diagnostics: tuple[Diagnostic, ...]


def first_file(path: Path) -> Path:
    """The first file: `path`, or `fleet.yaml` in it if it is a directory."""
    return path / FIRST_FILE if os.path.isdir(path) else path


def include_path(written: str, including: Path, environ: Mapping[str, str]) -> Path | None:
    """The path that an `include` entry of the file `including` names; None if its `~` needs `HOME`, which is unset."""
    if not written.startswith("~/"):
        return including.parent / written
    home = environ.get("HOME", "")
    return Path(home) / written[2:] if home else None


def read_files(path: Path, environ: Mapping[str, str], read: Reader = read_bytes) -> MergedFiles:
    """Read `path` and its includes. An include's `~` is `HOME` of `environ`."""
    first = first_file(path)
    boundary = Boundary.of(first.parent, environ)
    # any other file was named by the user, such as `<(COMMAND)`
    refusal = boundary.refusal(first) if first != path or boundary.is_work_tree else ""
    if refusal:
        hint = HINT if refusal.startswith("outside") else ""
        error = codes.error(codes.UNREADABLE, Position(str(first)), f"cannot be read: {refusal}", hint=hint)
        return MergedFiles(None, (), (error,))
    gathering = _FileMerger(environ, read, boundary)
    root = gathering.file(first, ())
    complete = root if not gathering.is_broken else None
    return MergedFiles(complete, tuple(gathering.files), tuple(gathering.diagnostics))


@dataclass(slots=True)
class _FileMerger:
    environ: Mapping[str, str]
    read: Reader
    boundary: Boundary
    files: list[Path] = field(default_factory=list)
    diagnostics: list[Diagnostic] = field(default_factory=list)
    is_broken: bool = False
    weight: int = 0

    def file(self, path: Path, above: tuple[str, ...]) -> MappingNode | None:
        """Read a file and its includes; `above` are the resolved paths of the including files."""
        source = read_source(path, self.read)
        if not isinstance(source, Source):
            is_first_missing = source.code == codes.UNREADABLE and not above
            place = path.absolute().parent
            start = (
                f"expected in {place}: name another with `--inventory`, or write a first one with `meshctl init DIR`"
            )
            hint = start if is_first_missing else ""
            self._fail(replace(source, hint=source.hint or hint))
            return None
        self.files.append(path)
        composed = compose(source)
        self.diagnostics.extend(composed.diagnostics)
        root = composed.root
        if root is None:
            self.is_broken = True
            return None
        if not isinstance(root, MappingNode):
            what = "the file is empty" if isinstance(root, Scalar) and root.is_null else ""
            code = codes.EMPTY if what else codes.WRONG_VALUE
            self._fail(codes.error(code, position(root), what, expected="a mapping of keys", found=describe(root)))
            return None
        self.weight += root.weight
        if self.weight > MAX_VALUES:
            self._fail(
                codes.error(
                    codes.TOO_MANY_VALUES,
                    position(root),
                    "too many values in all files",
                    expected=f"at most {MAX_VALUES}",
                )
            )
            return None
        self._follow_includes(root, path, (*above, os.path.realpath(path)))
        return root

    def _fail(self, diagnostic: Diagnostic) -> None:
        self.is_broken = True
        self.diagnostics.append(diagnostic)

    def _follow_includes(self, root: MappingNode, path: Path, above: tuple[str, ...]) -> None:
        includes = root.values.get("include")
        if not isinstance(includes, SequenceNode):
            return
        for item in includes.items:
            if self.is_broken and len(self.diagnostics) > MAX_FILES:
                return
            target = self._target(item, path)
            if target is None:
                continue
            real = os.path.realpath(target)
            if refusal := self.boundary.refusal(target):
                problem = codes.error(codes.INCLUDE, position(item), f"the include {target} is {refusal}")
                self._fail(replace(problem, hint=HINT if refusal.startswith("outside") else ""))
            elif real in above:
                circle = " -> ".join(Path(name).name for name in (*above[above.index(real) :], real))
                self._fail(codes.error(codes.INCLUDE, position(item), f"include cycle: {circle}"))
            elif any(os.path.realpath(known) == real for known in self.files):
                self._fail(codes.error(codes.INCLUDE, position(item), f"{target} is included twice"))
            elif len(self.files) >= MAX_FILES:
                self._fail(
                    codes.error(codes.INCLUDE, position(item), "too many files", expected=f"at most {MAX_FILES} files")
                )
                return
            else:
                known = len(self.diagnostics)
                below = self.file(target, above)
                self._report_at_include(item, target, known)
                if below is not None:
                    self._merge(root, below)

    def _target(self, item: Tree, path: Path) -> Path | None:
        """The path of an `include` entry; None if it is not text, which validation reports."""
        if not isinstance(item, Scalar) or item.is_null:
            return None
        if "\0" in item.text:
            self._fail(codes.error(codes.INCLUDE, position(item), "not a path: it contains a NUL character"))
            return None
        target = include_path(item.text, path, self.environ)
        if target is None:
            self._fail(codes.error(codes.INCLUDE, position(item), "`~` needs the environment variable HOME"))
        return target

    def _report_at_include(self, item: Scalar | Tree, target: Path, known: int) -> None:
        """Report an unreadable file at its include."""
        for number in range(known, len(self.diagnostics)):
            problem = self.diagnostics[number]
            if problem.code == codes.UNREADABLE and problem.position.file == str(target):
                self.diagnostics[number] = codes.error(
                    codes.UNREADABLE, position(item), f"the include {target} {problem.message}", hint=_hint(target)
                )

    def _merge(self, root: MappingNode, below: MappingNode) -> None:
        """Add the keys of an included file; mappings in both are merged key by key."""
        for key, value in below.values.items():
            existing = root.values.get(key)
            if key == "include" or (key == "meshctl" and existing is not None and _same_text(existing, value)):
                continue
            if existing is None or (isinstance(existing, Scalar) and existing.is_null):
                root.keys[key], root.values[key] = below.keys[key], value
            elif isinstance(existing, MappingNode) and isinstance(value, MappingNode):
                joined = MappingNode(
                    existing.file, existing.line, existing.column, existing.start, existing.end, existing.is_flow
                )
                joined.keys.update(existing.keys)
                joined.values.update(existing.values)
                self._join(key, joined, value)
                root.values[key] = joined
            elif not (isinstance(value, Scalar) and value.is_null):
                self._clash(key, root.keys[key], below.keys[key])

    def _join(self, section: str, existing: MappingNode, other: MappingNode) -> None:
        for key, value in other.values.items():
            if key in existing.values:
                self._clash(f"{section}.{key}", existing.keys[key], other.keys[key])
            else:
                existing.keys[key], existing.values[key] = other.keys[key], value

    def _clash(self, path: str, first: Scalar, second: Scalar) -> None:
        self.diagnostics.append(
            codes.error(
                codes.INCLUDE_CLASH,
                position(second),
                "set in two files",
                path=path,
                found=f"also in {position(first)}",
                hint="remove it from one of them",
            )
        )


def _same_text(left: Tree, right: Tree) -> bool:
    return isinstance(left, Scalar) and isinstance(right, Scalar) and left.text == right.text


def _hint(target: Path) -> str:
    is_pattern = any(character in target.name for character in "*?[")
    return "patterns are not expanded: list each file" if is_pattern else ""
