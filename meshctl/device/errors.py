"""Errors between meshctl and one node. Each is a `NodeError`, which a fleet run turns into that node's outcome.

Messages name the node (`Endpoint.label`), what was attempted and what was found. Exceptions of paramiko and `OSError`
do not leave this package.
"""

from __future__ import annotations

from meshctl.errors import NodeError, Unreachable

__all__ = [
    "AuthenticationRefused",
    "ChannelClosed",
    "CommandEnded",
    "CommandFailed",
    "ConnectionLost",
    "HostKeyChanged",
    "HostKeyUnknown",
    "IncompatibleServer",
    "NodeRefused",
    "OutputTooLarge",
    "Timeout",
    "Unreachable",
    "UploadFailed",
]


# Phases of a login once its server has accepted the connection.
HANDSHAKE, AUTHENTICATION = "the SSH handshake", "authentication"


class Timeout(Unreachable):
    """One of our deadlines passed; `phase` is which: connect, handshake, auth, channel, run."""

    def __init__(self, message: str, *, phase: str, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.phase = phase

    @property
    def is_server_silent(self) -> bool:
        """Whether the SSH server has accepted the connection, and then did not answer."""
        return self.phase in (HANDSHAKE, AUTHENTICATION)


class ConnectionLost(Unreachable):
    """The connection was closed or reset, by the other side or by the network."""


class ChannelClosed(ConnectionLost):
    """The channel ended without an exit status: the command or the server's process was killed."""


class CommandEnded(ConnectionLost):
    """A command that exchanges lines with us ended; `exit_status` is None if the server did not report one."""

    def __init__(self, message: str, *, exit_status: int | None) -> None:
        super().__init__(message)
        self.exit_status = exit_status


class IncompatibleServer(NodeError):
    """The peer is not an SSH server, or supports no algorithm that we do."""


class HostKeyUnknown(NodeError):
    """No key is pinned for this node; `fingerprint` is that of its key (`SHA256:...`)."""

    def __init__(self, message: str, *, fingerprint: str, key_type: str, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.fingerprint = fingerprint
        self.key_type = key_type


class HostKeyChanged(NodeError):
    """The node's key differs from the pinned one: another device, a flash without meshctl, or an attack."""

    def __init__(
        self, message: str, *, fingerprint: str, key_type: str, pinned: tuple[str, ...] = (), hint: str = ""
    ) -> None:
        super().__init__(message, hint=hint)
        self.fingerprint = fingerprint
        self.key_type = key_type
        self.pinned = pinned


class AuthenticationRefused(NodeError):
    """The node refused all credentials in `tried`; `allowed` are the methods the server offers."""

    def __init__(
        self, message: str, *, tried: tuple[str, ...] = (), allowed: tuple[str, ...] = (), hint: str = ""
    ) -> None:
        super().__init__(message, hint=hint)
        self.tried = tried
        self.allowed = allowed


class CommandFailed(NodeError):
    """A command on the node ended with a nonzero exit status."""

    def __init__(self, message: str, *, exit_status: int, stderr: str = "", hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.exit_status = exit_status
        self.stderr = stderr


class OutputTooLarge(NodeError):
    """A command on the node printed more than is read into memory; the connection stays usable."""


class UploadFailed(NodeError):
    """The uploaded bytes do not match, or did not fit; the target file is unchanged."""


class NodeRefused(CommandFailed):
    """The node's dead-man's switch refused a command; `code` is the reason (docs/device-scripts.md)."""

    def __init__(self, message: str, *, code: str, exit_status: int, hint: str = "") -> None:
        super().__init__(message, exit_status=exit_status, stderr=message, hint=hint)
        self.code = code
