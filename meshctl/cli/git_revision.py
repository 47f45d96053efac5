"""An inventory argument: a path, or `REVISION:PATH` in the surrounding git repository.

The whole revision is checked out into a temporary directory, because an inventory may include files beside it. The
repository's work tree and index are not touched.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError

# a local repository answers at once; a longer wait is a hang
_GIT_TIMEOUT_S = 120


@contextmanager
def checkout(argument: str) -> Iterator[Path]:
    """The inventory at `argument`, readable within the context; an existing path wins over a revision. Raises
    InputError if there is none.

    Errors of the inventory that are raised within the context have positions in the revision.
    """
    revision, colon, path = argument.partition(":")
    if Path(argument).exists() or not colon:
        if not Path(argument).exists() and _commit(argument, dict(os.environ)):
            hint = f"for a revision of git, add the path of the inventory in it, such as {argument}:./"
            raise InputError(f"{argument}: no such file or directory", hint=hint)
        yield Path(argument)
        return
    with tempfile.TemporaryDirectory(prefix="meshctl-diff-") as folder:
        tree = Path(folder) / "tree"
        tree.mkdir()
        environ = {**os.environ, "GIT_INDEX_FILE": str(Path(folder) / "index")}
        top = _git("rev-parse", "--show-toplevel", environ=environ)
        # as in git: paths are relative to the top of the repository, with ./ to the current directory
        prefix = _git("rev-parse", "--show-prefix", environ=environ) if path.startswith(("./", "../")) else ""
        commit = _commit(revision, environ)
        if not commit:
            raise InputError(f"{argument}: no revision '{revision}' in {top}", hint="`git log` lists revisions")
        _git("-C", top, "read-tree", commit, environ=environ)
        _git("-C", top, "checkout-index", "--all", f"--prefix={tree}/", environ=environ)
        # marks the root, so that includes stay within it
        (tree / ".git").touch()
        inside = Path(os.path.normpath(tree / prefix / path))
        if not inside.exists() or not inside.is_relative_to(tree):
            raise InputError(f"{argument}: no such file or directory in {revision}")
        try:
            yield inside
        except InvalidInput as error:
            root, label = f"{tree}/", f"{revision}:"
            raise InvalidInput(
                replace(item, position=replace(item.position, file=item.position.file.replace(root, label)))
                for item in error.diagnostics
            ) from error


def _commit(revision: str, environ: dict[str, str]) -> str:
    """The commit that git knows by this name; empty if there is none."""
    try:
        return _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}", environ=environ)
    except InputError:
        return ""


def _git(*arguments: str, environ: dict[str, str]) -> str:
    """The stripped output of git. Raises InputError with git's error message."""
    command = ["git", *arguments]
    try:
        done = subprocess.run(
            command,
            env=environ,
            capture_output=True,
            text=True,
            timeout=_GIT_TIMEOUT_S,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except FileNotFoundError:
        raise InputError("git is not installed", hint="install git to compare revisions") from None
    except subprocess.TimeoutExpired:
        raise InputError(f"git timed out after {_GIT_TIMEOUT_S} s: {' '.join(command)}") from None
    if done.returncode != 0:
        reason = done.stderr.strip() or f"exit status {done.returncode}"
        raise InputError(f"git {arguments[0] if arguments[0] != '-C' else arguments[2]}: {reason}")
    return done.stdout.strip()
