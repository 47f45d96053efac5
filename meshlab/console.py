"""A node's serial console on the user's terminal."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import sys
import termios
import threading
import tty
from typing import TYPE_CHECKING

from meshlab.errors import LabError

if TYPE_CHECKING:
    from meshlab.fleet import VirtualFleet


def run_shell(fleet: VirtualFleet, node: str, command: str) -> int:
    """Run `command` (empty: an interactive shell) on a node with this process's stdin, stdout and stderr.

    Returns its exit status. On a terminal the node gets its own pseudo-terminal, so that Ctrl-C goes to the node.
    """
    if command or not sys.stdin.isatty():
        answer = fleet.request_with_fds((0, 1, 2), None, "exec", node=node, command=command)
        return _status(answer, node)
    ours, theirs = pty.openpty()
    with contextlib.suppress(OSError):
        termios.tcsetwinsize(theirs, termios.tcgetwinsize(0))
    answers: list[dict[str, object]] = []

    def ask() -> None:
        try:
            answers.append(fleet.request_with_fds((theirs, theirs, theirs), None, "exec", node=node, command=""))
        finally:
            os.close(theirs)

    asking = threading.Thread(target=ask)
    before = termios.tcgetattr(0)
    try:
        tty.setraw(0)
        asking.start()
        _relay(ours)
    finally:
        termios.tcsetattr(0, termios.TCSADRAIN, before)
        os.close(ours)
        asking.join()
    return _status(answers[0], node) if answers else 1


def _relay(terminal: int) -> None:
    """Copy input to the node's terminal and its output back until the shell ends."""
    while True:
        ready, _, _ = select.select([0, terminal], [], [])
        try:
            if terminal in ready:
                output = os.read(terminal, 4096)
                if not output:
                    return
                os.write(1, output)
            if 0 in ready:
                keys = os.read(0, 4096)
                if not keys:
                    return
                os.write(terminal, keys)
        except OSError:
            # EIO: the last process on the terminal has ended
            return


def _status(answer: dict[str, object], node: str) -> int:
    if answer.get("reason"):
        raise LabError(f"{node}: {answer['reason']}")
    return int(str(answer["status"]))
