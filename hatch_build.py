"""Adds the man pages to the wheel (share/man/man1), generated from the commands' own definitions."""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ManPages(BuildHookInterface):  # type: ignore[type-arg]
    """The commands are imported, so the build needs what they need (`require-runtime-dependencies`)."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable":
            # a developer's environment would keep the pages of the day it was made
            return
        sys.path.insert(0, self.root)
        try:
            from docgen.pages import man_pages

            pages = man_pages()
        finally:
            sys.path.remove(self.root)
        directory = Path(mkdtemp(prefix="meshctl-man."))
        for name, text in pages.items():
            (directory / name).write_text(text, encoding="utf-8")
            build_data["shared_data"][str(directory / name)] = f"share/man/man1/{name}"
