"""The errors of meshctl, each with its exit code.

Foreign exceptions (paramiko, OSError, yaml) are translated into one of these at the boundary. One node's failure is an
outcome, not an error: it never stops a fleet.
"""

from __future__ import annotations

from enum import IntEnum
from typing import ClassVar


class ExitCode(IntEnum):
    """The exit codes of all commands."""

    OK = 0
    # the command ran and found something to act on: lint findings, drift, a degraded or partly failed fleet
    FINDINGS = 1
    # the command could not run: bad usage, unreadable or invalid input, missing tools
    COULD_NOT_RUN = 2
    # nodes that were needed could not be reached
    UNREACHABLE = 3
    # 128 + SIGINT, as shells report it
    INTERRUPTED = 130


class MeshctlError(Exception):
    """Base of all errors; `str()` is the message, `hint` says how to fix it."""

    exit_code: ClassVar[ExitCode] = ExitCode.COULD_NOT_RUN

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.hint = hint


class InputError(MeshctlError):
    """An invalid file or argument; the message has file, line, what was expected and what was found."""


class NodeError(MeshctlError):
    """A failure of one node; becomes that node's outcome. `gateway_of` is the site whose gateway is what failed on the
    way to the node."""

    exit_code = ExitCode.FINDINGS
    gateway_of: str = ""


class Unreachable(NodeError):
    """A node did not answer within its deadline."""

    exit_code = ExitCode.UNREACHABLE
