"""Write the commented starter inventory that ships with meshctl into a directory."""

from __future__ import annotations

from pathlib import Path

from meshctl.errors import InputError
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
    created: list[Path] = []
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name in names:
            with (directory / name).open("xb") as stream:
                created.append(directory / name)
                stream.write((source / name).read_bytes())
        if ssh_key:
            editor = Editor.open(directory)
            editor.set(("operators", "ssh_keys"), [ssh_key])
            save(editor.changes())
    except BaseException as reason:
        # a part of a file would be an inventory with errors, which the next `init` does not overwrite
        for path in created:
            path.unlink(missing_ok=True)
        if isinstance(reason, OSError):
            raise InputError(f"{reason.filename or directory} cannot be written: {reason.strerror}") from reason
        raise
    return tuple(created)
