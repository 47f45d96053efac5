"""`--file` of the imports: the file of the inventory that gets new nodes, where several have some."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from meshctl.errors import InputError
from meshctl.inventory.edit import Editor

NEW_NODES_FILE = "The file of the inventory that gets new nodes, if several have nodes."
NewNodesFile = Annotated[Path | None, typer.Option("--file", metavar="FILE", help=NEW_NODES_FILE)]


def file_of_new_nodes(editor: Editor, given: Path | None) -> Path:
    """The inventory's file for new nodes. Raises InputError where that is the operator's choice."""
    files = editor.files()
    if given is not None:
        # as the shell sees it, or, as in `include`, beside the inventory's first file
        meant = (given.resolve(), (files[0].parent / given).resolve())
        found = next((file for file in files if file.resolve() in meant), None)
        if found is None:
            listed = ", ".join(map(str, files))
            raise InputError(f"--file {given}: expected a file of the inventory, one of {listed}")
        return found
    candidates = editor.files_with_nodes() or files[:1]
    if len(candidates) > 1:
        raise InputError(
            f"{len(candidates)} files of the inventory have nodes: {', '.join(map(str, candidates))}",
            hint=f"say which one gets the new nodes: --file {candidates[-1]}",
        )
    return candidates[0]
