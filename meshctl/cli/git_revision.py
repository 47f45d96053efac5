"""An inventory named on the command line: a path, or `REVISION:PATH` in the git repository around us.

A revision is unpacked whole into a folder of its own, because an inventory may include files beside it; neither the
work tree nor the index of the repository is touched.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.inventory import load_fleet
from meshctl.model import Fleet

# git answers at once from a local repository; one that waits longer waits for something that never comes
_GIT_TIMEOUT_S = 120


@dataclass(frozen=True, slots=True)
class InventoryCheckout:
    """`path` can be read while the context of `opened` lasts; messages say `shown` in place of `root`."""

    path: Path
    root: str = ""
    label: str = ""

    def fleet(self) -> Fleet:
        """The fleet. Raises InvalidInput, whose places name the revision."""
        try:
            return load_fleet(self.path, environ=os.environ)
        except InvalidInput as error:
            if not self.root:
                raise
            raise InvalidInput(
                replace(item, position=replace(item.position, file=item.position.file.replace(self.root, self.label)))
                for item in error.diagnostics
            ) from error


@contextmanager
def checkout(argument: str) -> Iterator[InventoryCheckout]:
    """The inventory that `argument` names: what exists as a path is one. Raises InputError when there is none."""
    revision, colon, path = argument.partition(":")
    if Path(argument).exists() or not colon:
        yield InventoryCheckout(Path(argument))
        return
    with tempfile.TemporaryDirectory(prefix="meshctl-diff-") as folder:
        tree = Path(folder) / "tree"
        tree.mkdir()
        environ = {**os.environ, "GIT_INDEX_FILE": str(Path(folder) / "index")}
        top = _git("rev-parse", "--show-toplevel", environ=environ)
        # like git itself: a path is meant from the repository's top, with ./ from here
        prefix = _git("rev-parse", "--show-prefix", environ=environ) if path.startswith(("./", "../")) else ""
        commit = _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}", environ=environ)
        _git("-C", top, "read-tree", commit, environ=environ)
        _git("-C", top, "checkout-index", "--all", f"--prefix={tree}/", environ=environ)
        # marks the unpacked tree as one, so that includes stay within it
        (tree / ".git").touch()
        inside = Path(os.path.normpath(tree / prefix / path))
        if not inside.exists() or not inside.is_relative_to(tree):
            raise InputError(f"{argument}: expected a file or directory of {revision}, found none")
        yield InventoryCheckout(inside, f"{tree}/", f"{revision}:")


def _git(*arguments: str, environ: dict[str, str]) -> str:
    """The output of git, without its line end. Raises InputError with git's own words."""
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
        raise InputError("git is not installed; it is needed to compare revisions") from None
    except subprocess.TimeoutExpired:
        raise InputError(f"git did not answer within {_GIT_TIMEOUT_S} s: {' '.join(command)}") from None
    if done.returncode != 0:
        reason = done.stderr.strip() or f"it ended with {done.returncode}"
        raise InputError(f"git {arguments[0] if arguments[0] != '-C' else arguments[2]}: {reason}")
    return done.stdout.strip()
