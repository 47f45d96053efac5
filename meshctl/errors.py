"""The errors that meshctl itself raises, each with the exit code a script sees.

Foreign exceptions (paramiko, OSError, yaml) are translated once, at the edge, into one of these. One node's failure is
an outcome, not an error: it never stops a fleet.
"""

from __future__ import annotations

from enum import IntEnum
from typing import ClassVar


class ExitCode(IntEnum):
    """What a script can tell from the exit status of every command."""

    OK = 0
    # the command ran and found something to act on: lint findings, drift, a degraded or partly failed fleet
    FINDINGS = 1
    # the command could not do its work: bad usage, unreadable or invalid input, missing tools
    COULD_NOT_RUN = 2
    # nodes that were needed could not be reached
    UNREACHABLE = 3
    # 128 + SIGINT, as shells report it
    INTERRUPTED = 130


class MeshctlError(Exception):
    """Anything meshctl reports to a person; `str()` is the whole message, `hint` says how to mend it."""

    exit_code: ClassVar[ExitCode] = ExitCode.COULD_NOT_RUN

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint


class InputError(MeshctlError):
    """A file or argument from the user that cannot be used; names file, line, what was expected, what was found."""


class NodeError(MeshctlError):
    """One node's failure; fleets turn it into that node's outcome."""

    exit_code = ExitCode.FINDINGS


class Unreachable(NodeError):
    """A node that did not answer within its deadline."""

    exit_code = ExitCode.UNREACHABLE
