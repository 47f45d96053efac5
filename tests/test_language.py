"""Messages, docstrings, comments and docs use plain technical English: words that read as if translated stay out."""

from __future__ import annotations

import ast
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.plain_english import bad_page_words, bad_words, has_listed_word

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("meshctl", "meshlab", "mesh_sweep", "udp_mesh")
# records of what others wrote, and of releases that are out
RECORDS = ("docs/facts/",)


TEST_PACKAGES = ("benchmarks", "docgen", "tests")


def comments_of(file: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each comment, of files in which any may have a bad word."""
    # a comment is in one line, and few files have such a line: only these are tokenized
    if not any("#" in line and has_listed_word(line) for line in file.read_text(encoding="utf-8").split("\n")):
        return
    with file.open("rb") as source:
        for token in tokenize.tokenize(source.readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string


def texts_of(file: Path, *, with_strings: bool) -> Iterator[tuple[int, str]]:
    """Line and text of each docstring, comment and name that a file defines, and of its other strings if asked for."""
    yield from comments_of(file)
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name.replace("_", " ")
                yield node.lineno, "" if with_strings else ast.get_docstring(node) or ""
            case ast.Module() if not with_strings:
                yield 1, ast.get_docstring(node) or ""
            case ast.Constant(value=str(text)) if with_strings:
                yield node.lineno, text
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield node.lineno, name.replace("_", " ")


@pytest.mark.parametrize("package", [*PACKAGES, *TEST_PACKAGES])
def test_code_uses_plain_words(package: str) -> None:
    """Names, docstrings and comments, and the messages of the packages."""
    bad = [
        f"{file.relative_to(ROOT)}:{line}: {word}"
        for file in sorted((ROOT / package).rglob("*.py"))
        for line, text in texts_of(file, with_strings=package in PACKAGES)
        for word in bad_words(text)
    ]
    assert bad == []


def test_docs_use_plain_words() -> None:
    files = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    bad = [
        f"{name}:{number}: {word}"
        for file in files
        if not (name := str(file.relative_to(ROOT))).startswith(RECORDS)
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
        for word in bad_words(line)
    ]
    assert bad == []


def test_a_bad_word_in_a_comment_is_found(tmp_path: Path) -> None:
    file = tmp_path / "module.py"
    file.write_text('first = "no # comment"\nsecond = 2  # whoever reads it\n', encoding="utf-8")
    assert list(comments_of(file)) == [(2, "# whoever reads it")]


def test_listed_words_are_found() -> None:
    assert bad_words("nobody tells of b07, run `meshctl lab mend`") == ["nobody", "tells of"]
    assert bad_words("names no-nobody; `mend`") == []
    assert bad_page_words("Tells `colour` of a behaviour") == ["Tells", "behaviour"]
