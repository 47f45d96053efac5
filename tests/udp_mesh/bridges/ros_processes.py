"""Real ROS 1 masters, bridges and nodes for tests, each a process in ROS's own interpreter."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import udp_mesh
from tests.udp_mesh.daemon.processes import RunningDaemon, poll
from tests.udp_mesh.links.sockets import WAIT_S

ROOT = Path(udp_mesh.__file__).parent.parent
ROS_PYTHON = "/usr/bin/python3"
ROBOT = Path(__file__).with_name("ros_robot.py")


def free_tcp_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def stop(process: subprocess.Popen[Any], number: signal.Signals = signal.SIGINT) -> None:
    """Ends it as a person would; kills it where that does not help."""
    if process.poll() is None:
        process.send_signal(number)
        try:
            process.wait(WAIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class Master:
    """One robot's roscore."""

    def __init__(self, folder: Path, name: str) -> None:
        self.port = free_tcp_port()
        self.log = folder / f"{name}-roscore.log"
        self.environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith(("ROS", "PYTHON", "VIRTUAL"))},
            "PATH": "/usr/bin:/bin",
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(folder / f"{name}-ros"),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                ["/usr/bin/roscore", "-p", str(self.port)], env=self.environment, stdout=log, stderr=subprocess.STDOUT
            )
        poll(self._answers, f"roscore: {self.log}")

    def _answers(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def stop(self) -> None:
        if self.process is not None:
            stop(self.process)
            self.process = None


class Robot:
    """A node in a robot's ROS graph."""

    def __init__(self, master: Master, name: str) -> None:
        self.process = subprocess.Popen(
            [ROS_PYTHON, str(ROBOT), name],
            env=master.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._lines: deque[dict[str, Any]] = deque()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        self.expect("ready")

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("{"):
                self._lines.append(json.loads(line))

    def _tell(self, **command: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()

    def expect(self, field: str, value: object = None) -> dict[str, Any]:
        """Waits for a line with this field (and value); takes it out."""

        def found() -> dict[str, Any] | None:
            for line in list(self._lines):
                if field in line and (value is None or line[field] == value):
                    self._lines.remove(line)
                    return line
            return None

        return poll(found, f"{field} = {value!r}, so far {list(self._lines)}")

    def received(self) -> list[dict[str, Any]]:
        """Messages that came and were not taken."""
        return [line for line in list(self._lines) if "name" in line]

    def subscribe(self, name: str, type_name: str = "std_msgs/String") -> None:
        self._tell(subscribe=name, type=type_name)

    def publish(self, name: str, data: object, type_name: str = "std_msgs/String", **more: object) -> int:
        """Publishes; returns how many subscribers were connected."""
        self._tell(publish=name, type=type_name, data=data, **more)
        return int(self.expect("connections")["connections"])

    def publish_until_heard(self, name: str, data: str, hearer: Robot, **more: Any) -> dict[str, Any]:
        """Publishes again and again until the other robot has it: a new topic's first messages may be lost in ROS."""

        def heard() -> dict[str, Any] | None:
            self.publish(name, data, **more)
            return next((line for line in hearer.received() if line.get("data") == data), None)

        return poll(heard, f"{data!r} on {name}")

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        stop(self.process, signal.SIGTERM)
        self._reader.join(WAIT_S)
        assert self.process.stdout is not None
        self.process.stdout.close()


class BridgeProcess:
    """One robot's bridge, started by hand or by roslaunch."""

    def __init__(self, folder: Path, master: Master, daemon: RunningDaemon) -> None:
        self._folder, self._master, self._daemon = folder, master, daemon
        self.log = folder / f"{daemon.name}-bridge.log"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self, *, launch: bool = False, arguments: Sequence[str] = ()) -> None:
        environment = {**self._master.environment, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        command = [ROS_PYTHON, "-m", "udp_mesh.bridges.ros1", f"_socket:={self._daemon.socket}"]
        if launch:
            package = ROOT / "udp_mesh" / "bridges" / "ros1"
            environment = {**self._master.environment, "ROS_PACKAGE_PATH": str(package)}
            command = ["/usr/bin/roslaunch", "udp_mesh", "rudp_mesh_node.launch", f"mesh_socket:={self._daemon.socket}"]
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*command, *arguments], env=environment, cwd=self._folder, stdout=log, stderr=subprocess.STDOUT
            )

    def stop(self) -> None:
        if self.process is not None:
            stop(self.process)
            self.process = None
