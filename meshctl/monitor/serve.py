"""Run the page's server on one address until Ctrl-C or SIGTERM."""

from __future__ import annotations

import ipaddress
import logging
import signal
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import uvicorn
from starlette.applications import Starlette

from meshctl.errors import InputError
from meshctl.model.ip import host_and_port
from meshctl.monitor.feed import Feed

# Streams end at once when the server stops; a download gets this long.
SHUTDOWN_S = 2


@dataclass(frozen=True, slots=True)
class Certificate:
    """PEM files."""

    certificate: Path
    key: Path


def check_certificate(certificate: Certificate) -> None:
    """Raises InputError for files that are missing, damaged, encrypted or do not belong together."""
    try:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        # asks no terminal for a password
        context.load_cert_chain(certificate.certificate, certificate.key, password="")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"cannot use {certificate.certificate} and {certificate.key}: {reason}",
            hint="expected a certificate chain and its unencrypted key, both PEM",
        ) from error


def listen(host: str, port: int) -> socket.socket:
    """A listening socket. Raises InputError."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=128)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"cannot listen on {host} port {port}: {reason}", hint="choose another one with --listen or --port"
        ) from error


def is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def address_of(listening: socket.socket, token: str, *, is_tls: bool) -> str:
    """The page's address, with the token behind `#`, which browsers send to no server."""
    host, port = listening.getsockname()[:2]
    if ipaddress.ip_address(host).is_unspecified:
        host = socket.gethostname()
    return f"{'https' if is_tls else 'http'}://{host_and_port(host, port)}/{f'#token={token}' if token else ''}"


class _Server(uvicorn.Server):
    """Ends the event streams when a signal arrives: they would keep the server from stopping."""

    def __init__(self, config: uvicorn.Config, feed: Feed) -> None:
        super().__init__(config)
        self._feed = feed
        self.signal = 0

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self.signal = sig
        self._feed.close()
        super().handle_exit(sig, frame)


def serve(app: Starlette, listening: socket.socket, feed: Feed, certificate: Certificate | None) -> int:
    """Serve until a signal; returns its number, and leaves the handlers as they were."""
    log = logging.getLogger("uvicorn.error")
    log.setLevel(logging.WARNING)
    # an answer that was cut off because the server ends is no fault of the program
    log.addFilter(lambda record: not feed.is_closed)
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=SHUTDOWN_S,
        ssl_certfile=None if certificate is None else str(certificate.certificate),
        ssl_keyfile=None if certificate is None else str(certificate.key),
    )
    server = _Server(config, feed)
    # uvicorn raises the signal again at its end, for the handlers of others
    before = {number: signal.signal(number, lambda *_: None) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        server.run(sockets=[listening])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        listening.close()
    return server.signal
