"""What a decoder raises: bad bytes are counted and dropped by the node, they never end it."""


class DecodeError(ValueError):
    """These bytes are no valid datagram, header, frame or legacy message; the text says what was expected and found."""


class UnknownVersionError(DecodeError):
    """A datagram of this protocol in a version we do not speak; `version` is what it claims (unauthenticated)."""

    def __init__(self, version: int) -> None:
        super().__init__(f"wire version {version} is not spoken here")
        self.version = version
