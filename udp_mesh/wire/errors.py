"""Errors of decoders. A node counts and drops bad bytes; they never stop it."""


class DecodeError(ValueError):
    """Not a valid datagram, header, frame or legacy message; the text says what was expected and found."""


class UnknownVersionError(DecodeError):
    """A datagram of this protocol in an unsupported version; `version` is what it claims (unauthenticated)."""

    def __init__(self, version: int) -> None:
        super().__init__(f"wire version {version} is not supported")
        self.version = version
