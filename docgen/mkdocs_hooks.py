"""MkDocs hooks: generated reference pages, and the repository's own pages (README, ...) as pages of the site."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from docgen.pages import pages

_ROOT = Path(__file__).resolve().parent.parent
_REPOSITORY_PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
# a link to a directory shows its files in a repository browser; in the site it needs a page
_DIRECTORIES = {
    "decisions/": "decisions/0001-dependencies.md",
    "facts/": "facts/openwrt-facts.md",
    "lint/": "lint/index.md",
    "inventory/": "inventory.md",
}
# search in pages opened from disk needs it; Material would load it from a CDN
_SHIM = "iframe-worker.js"
_ITEM = re.compile(r"(?:[-*]|\d+\.) ")
_CODE = re.compile(r"`[^`]+`")
_LINK = re.compile(r"(?<=\]\()([^)#\s]+)(?=[)#])")


def on_files(files: Files, config: Any) -> Files:
    for name, text in pages().items():
        files.append(File.generated(config, f"reference/{name}", content=_relative(text, "../")))
    for source, target in _REPOSITORY_PAGES.items():
        text = (_ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, target, content=_LINK.sub(lambda link: _site_path(link[1]), text)))
    shim = Path(__file__).with_name(_SHIM).read_text(encoding="utf-8")
    files.append(File.generated(config, f"assets/{_SHIM}", content=shim))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links from docs/ to the repository's own pages, and to directories, lead to pages of the site."""
    up = "../" * page.file.src_uri.count("/")
    for source, target in _REPOSITORY_PAGES.items():
        markdown = markdown.replace(f"]({up}../{source}", f"]({up}{target}")
    for directory, target in _DIRECTORIES.items():
        markdown = markdown.replace(f"]({up}{directory})", f"]({up}{target})")
    return _adapted(markdown)


def _adapted(markdown: str) -> str:
    """CommonMark as Python-Markdown reads it: a blank line before lists and tables, bare pipes in a table's code."""
    lines: list[str] = []
    in_code = False
    previous = ""
    for line in markdown.splitlines():
        if line.lstrip().startswith("```"):
            in_code = not in_code
        begins = _ITEM.match(line) or line.startswith("|")
        continues = not previous.strip() or previous.startswith(("|", " ")) or _ITEM.match(previous)
        if begins and not continues and not in_code:
            lines.append("")
        if line.startswith("|") and not in_code:
            line = _CODE.sub(lambda code: code[0].replace(r"\|", "|"), line)
        lines.append(line)
        previous = line
    return "\n".join(lines) + "\n"


def _site_path(link: str) -> str:
    """Where a link of a page at the repository's root leads in the site."""
    inside = link.removeprefix("docs/")
    return _REPOSITORY_PAGES.get(link) or _DIRECTORIES.get(inside, inside)


def _relative(text: str, up: str) -> str:
    """Generated pages link to others as if they were in docs/ itself."""
    return _LINK.sub(lambda link: up + link[1] if link[1] not in pages() else link[1], text)
