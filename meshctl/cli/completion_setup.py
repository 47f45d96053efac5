"""`meshctl --install-completion`: typer writes the completion, and a line into the start file of the user's shell."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from meshctl.errors import InputError

_START_FILES = (".bashrc", ".zshrc")
_COMPLETION_BYTES = 8192
"""More than typer adds to all its files."""
_HINT = "print the completion with `meshctl --show-completion`, and save it where your shell finds it"


@contextmanager
def checked_installation() -> Iterator[None]:
    """Errors of typer's installation as InputError; none begins without the space that it needs.

    typer overwrites the start file in place: on a full disk the user would be left with an empty one.
    """
    home = Path.home()
    try:
        sizes = [path.stat().st_size for name in _START_FILES if (path := home / name).is_file()]
        with tempfile.TemporaryFile(dir=home) as probe:
            probe.write(bytes(sum(sizes) + _COMPLETION_BYTES))
            probe.flush()
        yield
    except OSError as error:
        place = f"{error.filename}: " if isinstance(error.filename, str) else f"in {home}: "
        raise InputError(f"cannot install the completion: {place}{error.strerror}", hint=_HINT) from error
    except UnicodeError as error:
        files = " or ".join(f"{home}/{name}" for name in _START_FILES)
        raise InputError(
            f"cannot install the completion: {files} is not in the encoding of your locale", hint=_HINT
        ) from error
