"""Messages, docstrings, comments and docs use plain technical English: words that read as if translated stay out."""

from __future__ import annotations

import ast
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("meshctl", "meshlab", "udp_mesh")
WORDS = re.compile(
    r"\b(told|anew|whoever|somebody|nobody|mend(s|ed|ing)?|tells? of|cope[sd]? with|take up what)\b",
    re.I,
)
# words of the command line and of the lab's protocol, and names of lint rules, which stay
ALLOWED = re.compile(r"lab mend\b|`mend`|^mend$|([a-z]+-)+nobody|nobody(-[a-z]+)+")
# records of what others wrote, and of releases that are out
RECORDS = ("docs/facts/",)


def words_of(file: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each string and comment."""
    with file.open("rb") as source:
        yield from (
            (token.start[0], token.string)
            for token in tokenize.tokenize(source.readline)
            if token.type == tokenize.COMMENT
        )
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def found(text: str) -> list[str]:
    return [match[0] for match in WORDS.finditer(ALLOWED.sub("", text))]


@pytest.mark.parametrize("package", PACKAGES)
def test_messages_docstrings_and_comments(package: str) -> None:
    bad = [
        f"{file.relative_to(ROOT)}:{line}: {word}"
        for file in sorted((ROOT / package).rglob("*.py"))
        for line, text in words_of(file)
        for word in found(text)
    ]
    assert bad == []


def test_docs() -> None:
    files = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    bad = [
        f"{name}:{number}: {word}"
        for file in files
        if not (name := str(file.relative_to(ROOT))).startswith(RECORDS)
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
        for word in found(line)
    ]
    assert bad == []


def test_a_word_of_the_list_is_found() -> None:
    assert found("nobody tells of b07, run `meshctl lab mend`") == ["nobody", "tells of"]
