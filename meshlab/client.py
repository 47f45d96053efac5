"""Requests to a running fleet's supervisor, over the socket in its directory."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from meshctl.errors import InputError
from meshlab.control import address_of
from meshlab.errors import LabError
from meshlab.kernel_log import CONSOLE, blocked_tasks
from meshlab.node_runner import MESSAGE_BYTES

ANSWER_S = 60.0
"""What an answer of a fleet may take."""
MACHINE_ANSWER_S = 300.0
"""The same of a fleet in an emulated machine, which is many times slower than its host."""


@contextmanager
def _connected(directory: Path, timeout_s: float | None = None) -> Iterator[socket.socket]:
    """A connection to the supervisor of `directory`. Raises OSError when none listens there."""
    directory_fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
            connection.settimeout(timeout_s)
            connection.connect(address_of(directory, directory_fd))
            yield connection
    finally:
        os.close(directory_fd)


def request(
    directory: Path, message: dict[str, Any], descriptors: Sequence[int] = (), *, timeout_s: float | None = ANSWER_S
) -> dict[str, Any]:
    """Send one request and return the reply.

    Raises LabError when no fleet runs in `directory`, the fleet ends meanwhile or `timeout_s` passes; InputError when
    the fleet rejects the request.
    """
    try:
        with _connected(directory, timeout_s) as connection:
            socket.send_fds(connection, [json.dumps(message).encode()], list(descriptors))
            answer = connection.recv(MESSAGE_BYTES * 4)
    except TimeoutError as error:
        silent = f"the fleet in {directory} did not answer {message['op']} within {timeout_s:g} s"
        raise LabError(silent + _reason(directory)) from error
    except OSError as error:
        raise LabError(f"no virtual fleet runs in {directory}", hint="run `meshctl lab up` to start one") from error
    if not answer:
        raise LabError(f"the fleet in {directory} ended before it answered {message['op']}")
    result: dict[str, Any] = json.loads(answer)
    if "error" in result:
        raise InputError(result["error"], hint=result.get("hint", ""))
    return result


def _reason(directory: Path) -> str:
    """The blocked tasks of the machine's kernel, for an error message; empty for none and without a machine."""
    console = directory / CONSOLE
    stuck = blocked_tasks(console.read_text(encoding="utf-8", errors="replace")) if console.exists() else ()
    return f"; its kernel reports blocked tasks: {'; '.join(stuck)}" if stuck else ""


def is_running(directory: Path) -> bool:
    """Whether a supervisor listens in `directory`, even one that does not answer."""
    try:
        with _connected(directory):
            return True
    except OSError:
        return False
