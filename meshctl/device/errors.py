"""What can go wrong between meshctl and one node; each is a `NodeError`, so a fleet turns it into that node's outcome.

The messages name the node (`Endpoint.label`), what was attempted and what was found. Nothing of paramiko or `OSError`
passes this package's edge.
"""

from __future__ import annotations

from meshctl.errors import NodeError, Unreachable

__all__ = [
    "AuthenticationRefused",
    "ChannelClosed",
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


class Timeout(Unreachable):
    """One of our own deadlines passed; `phase` says which: connect, handshake, auth, channel, run."""

    def __init__(self, message: str, *, phase: str, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.phase = phase


class ConnectionLost(Unreachable):
    """The connection was there and is gone: closed or reset by the other side, or by the network."""


class ChannelClosed(ConnectionLost):
    """The channel ended without an exit status: the command or the server's process was killed."""


class IncompatibleServer(NodeError):
    """Something answered that is no SSH server, or one with no algorithm in common with us."""


class HostKeyUnknown(NodeError):
    """No key is pinned for this node; `fingerprint` is what it showed (`SHA256:...`)."""

    def __init__(self, message: str, *, fingerprint: str, key_type: str, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.fingerprint = fingerprint
        self.key_type = key_type


class HostKeyChanged(NodeError):
    """The node shows another key than the pinned one: another device, a flash meshctl did not do, or an attack."""

    def __init__(
        self, message: str, *, fingerprint: str, key_type: str, pinned: tuple[str, ...] = (), hint: str = ""
    ) -> None:
        super().__init__(message, hint=hint)
        self.fingerprint = fingerprint
        self.key_type = key_type
        self.pinned = pinned


class AuthenticationRefused(NodeError):
    """The node is there and let none of our credentials in; `tried` lists them, `allowed` what the server offers."""

    def __init__(
        self, message: str, *, tried: tuple[str, ...] = (), allowed: tuple[str, ...] = (), hint: str = ""
    ) -> None:
        super().__init__(message, hint=hint)
        self.tried = tried
        self.allowed = allowed


class CommandFailed(NodeError):
    """A command on the node ended with a status other than zero."""

    def __init__(self, message: str, *, exit_status: int, stderr: str = "", hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.exit_status = exit_status
        self.stderr = stderr


class OutputTooLarge(NodeError):
    """A command on the node printed more than is read into memory; the connection is as good as before."""


class UploadFailed(NodeError):
    """The bytes on the node are not the bytes sent, or did not fit; nothing was put in place."""


class NodeRefused(CommandFailed):
    """The dead-man's switch on the node refused a verb; `code` is its reason's word (see docs/device-scripts.md)."""

    def __init__(self, message: str, *, code: str, exit_status: int, hint: str = "") -> None:
        super().__init__(message, exit_status=exit_status, stderr=message, hint=hint)
        self.code = code
