"""Errors of nats-py and of JetStream as those of meshctl. Pure."""

from __future__ import annotations

import asyncio
from collections import deque

from meshctl.errors import InputError, MeshctlError, Unreachable

HINT = "check the address, the credentials and the network; `nats.url` in the inventory"
_REFUSED = "permissions violation"
_REFUSED_HINT = "the server's configuration has to permit it: docs/how-to/permanent-sites.md"
_KEPT_REFUSALS = 64
# Codes of JetStream errors that room on the server's disk, or in its limits, cures: its limits are reached (in memory,
# on disk, of its account), a stream's files could not be made, and a message could not be stored.
_NO_ROOM = (10002, 10023, 10028, 10047, 10049, 10077)
_ROOM_HINT = (
    "make room on the disk of the NATS server, or make it writable, or raise its `max_file_store`; it reserves 100 MB"
    " for each site"
)
_NO_JETSTREAM_HINT = (
    "it is off, its disk is full or read-only, or the leaf node and the hub are not connected: "
    "look at the servers' logs"
)


class NatsLost(Unreachable):
    """The NATS server, or the stream behind it, cannot be reached."""


class Refusals:
    """What a server does not permit to our credentials. It never answers such a request, and says so apart from it."""

    def __init__(self, url: str) -> None:
        self._url = url
        # the number of each, from 1, and the server's words, which nats-py makes lower case
        self._known: deque[tuple[int, str]] = deque(maxlen=_KEPT_REFUSALS)
        self.count = 0
        self.reason = ""

    async def note(self, error: Exception) -> None:
        """An error beside the answers: of a connection that stays, or why none can be made (`reason`)."""
        self.reason = f": {error}" if str(error) else ""
        if _REFUSED in str(error):
            self.count += 1
            self._known.append((self.count, str(error).removeprefix("nats: ")))

    def check(self, since: int, *subjects: str) -> None:
        """Raises NatsLost if one of these subjects, or without subjects anything, was refused after `count` was
        `since`."""
        for number, text in tuple(self._known):
            if number > since and (not subjects or any(subject.lower() in text for subject in subjects)):
                raise NatsLost(f"NATS server {self._url}: {text}", hint=_REFUSED_HINT)


def not_installed(error: ImportError) -> InputError:
    return InputError(f"sites over NATS need nats-py: {error}", hint="pip install 'meshctl-fleet[nats]'")


def translated(error: BaseException, url: str) -> Unreachable | None:
    if isinstance(error, MeshctlError):
        return None
    from nats.errors import Error, NoRespondersError
    from nats.js.errors import APIError, ServiceUnavailableError

    match error:
        case NoRespondersError() | ServiceUnavailableError():
            return NatsLost(f"NATS server {url}: no JetStream answers", hint=_NO_JETSTREAM_HINT)
        case APIError() if error.err_code in _NO_ROOM:
            return NatsLost(f"NATS server {url} has no room: {error.description}", hint=_ROOM_HINT)
        case APIError():
            return NatsLost(f"NATS server {url}: {error.description or error}", hint=HINT)
        case Error() | asyncio.TimeoutError() | OSError():
            return NatsLost(f"NATS server {url}: {error}", hint=HINT)
        case _:
            return None
