"""Errors of nats-py and of JetStream as those of meshctl. Pure."""

from __future__ import annotations

import asyncio

from meshctl.errors import InputError, MeshctlError, Unreachable

HINT = "check the address, the credentials and the network; `nats.url` in the inventory"
# Codes of JetStream errors that room on the server's disk, or in its limits, cures: its limits are reached (in memory,
# on disk, of its account), and a message could not be stored.
_NO_ROOM = (10002, 10023, 10028, 10047, 10077)
_ROOM_HINT = "make room on the disk of the NATS server, or raise its `max_file_store`; it reserves 100 MB for each site"


class NatsLost(Unreachable):
    """The NATS server, or the stream behind it, cannot be reached."""


def not_installed(error: ImportError) -> InputError:
    return InputError(f"sites over NATS need nats-py: {error}", hint="pip install 'meshctl-fleet[nats]'")


def translated(error: BaseException, url: str) -> Unreachable | None:
    if isinstance(error, MeshctlError):
        return None
    from nats.errors import Error, NoRespondersError
    from nats.js.errors import APIError

    match error:
        case NoRespondersError():
            return NatsLost(f"NATS server {url}: no responders")
        case APIError() if error.err_code in _NO_ROOM:
            return NatsLost(f"NATS server {url} has no room: {error.description}", hint=_ROOM_HINT)
        case APIError():
            return NatsLost(f"NATS server {url}: {error.description or error}", hint=HINT)
        case Error() | asyncio.TimeoutError() | OSError():
            return NatsLost(f"NATS server {url}: {error}", hint=HINT)
        case _:
            return None
