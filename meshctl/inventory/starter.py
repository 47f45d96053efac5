"""Write the commented starter inventory that ships with meshctl into a directory."""

from __future__ import annotations

from pathlib import Path

from meshctl.errors import InputError
from meshctl.inventory.all_or_none import all_or_none
from meshctl.inventory.edit import Editor, save
from meshctl.resources import shipped


def write_starter(directory: Path, ssh_key: str = "") -> tuple[Path, ...]:
    """Copy the starter into `directory` and add `ssh_key`; returns the written files.

    Raises InputError, before anything is written, if one of the files exists.
    """
    source = shipped("inventory") / "starter"
    names = sorted(path.name for path in source.iterdir() if path.is_file())
    taken = [name for name in names if (directory / name).exists() or (directory / name).is_symlink()]
    if taken:
        raise InputError(f"{directory / taken[0]} already exists; not overwritten", hint="choose another directory")
    with all_or_none(directory) as new_files:
        for name in names:
            new_files.create(directory / name, (source / name).read_bytes())
        if ssh_key:
            editor = Editor.open(directory)
            editor.set(("operators", "ssh_keys"), [ssh_key])
            save(editor.changes())
    return tuple(directory / name for name in names)
