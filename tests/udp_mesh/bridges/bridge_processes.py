"""What the tests of both ROS bridges share: a bridge as a process, and a node as a process that the test drives."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.udp_mesh.daemon.processes import poll
from tests.udp_mesh.links.sockets import WAIT_S

LOG_FOLDERS: set[Path] = set()
"""Directories with the logs of masters, bridges, daemons and nodes; a failed test shows these logs."""
SHOWN_LINES = 20
"""How many of a node's last reports are shown when an expected one is missing."""


def stop(process: subprocess.Popen[Any], number: signal.Signals = signal.SIGINT) -> None:
    """Send a signal that ends the process; kill it after `WAIT_S`."""
    if process.poll() is None:
        process.send_signal(number)
        try:
            process.wait(WAIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class BridgeProcess:
    """One robot's bridge; a subclass starts it with `_run`."""

    def __init__(self, log: Path) -> None:
        LOG_FOLDERS.add(log.parent)
        self.log = log
        self.process: subprocess.Popen[bytes] | None = None

    def _run(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                command, env=environment, cwd=self.log.parent, stdout=log, stderr=subprocess.STDOUT
            )

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait(WAIT_S)
        self.process = None

    def stop(self) -> None:
        if self.process is not None:
            stop(self.process)
            self.process = None


class NodeProcess:
    """A ROS node that reads commands from standard input and reports on standard output, both as JSON lines.

    Its standard error goes to `log`. It reports that it is ready with a line that has the field `ready`, and a message
    with a line that has at least `name` and `data`.
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], log: Path) -> None:
        LOG_FOLDERS.add(log.parent)
        self.log = log
        with log.open("ab") as errors:
            self.process = subprocess.Popen(
                command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
            )
        self._lines: deque[dict[str, Any]] = deque()
        self._changing = threading.Lock()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        self.expect("ready")

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            # ROS prints there, too
            if line.startswith("{"):
                entry = json.loads(line)
                with self._changing:
                    self._lines.append(entry)

    def _command(self, **command: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()

    def publish(self, name: str, data: Any, **more: Any) -> Any:
        """Publish one message. What `more` may be, and what is returned, depends on the version of ROS."""
        raise NotImplementedError

    def expect(self, field: str, value: object = None) -> dict[str, Any]:
        """Wait for a line with this field (and value), and remove it from the lines."""

        def found() -> dict[str, Any] | None:
            with self._changing:
                for line in self._lines:
                    if field in line and (value is None or line[field] == value):
                        self._lines.remove(line)
                        return line
            assert self.process.poll() is None, f"the node has ended: {self.log.read_text()}"
            return None

        try:
            return poll(found, f"{field} = {value!r}")
        except AssertionError as error:
            shown = list(self._lines)[-SHOWN_LINES:]
            raise AssertionError(f"{error}; so far {shown}; {self.log.read_text()}") from None

    def received(self) -> list[dict[str, Any]]:
        """Messages that were received and not removed."""
        with self._changing:
            return [line for line in self._lines if "name" in line]

    def publish_until_received(
        self, name: str, data: str, receiver: NodeProcess, *, received_as: str = "", **more: Any
    ) -> dict[str, Any]:
        """Publish again and again until `receiver` has the message: a new topic's first messages may be lost in ROS.

        `received_as` is the topic's name at the receiver if that is another.
        """
        expected = {"name": received_as or name, "data": data}

        def found() -> dict[str, Any] | None:
            self.publish(name, data, **more)
            return next((line for line in receiver.received() if expected.items() <= line.items()), None)

        return poll(found, f"{data!r} on {expected['name']}")

    def kill(self) -> None:
        """End it at once, whatever it does."""
        self.process.kill()
        self.close()

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        stop(self.process, signal.SIGTERM)
        self._reader.join(WAIT_S)
        assert self.process.stdout is not None
        self.process.stdout.close()
