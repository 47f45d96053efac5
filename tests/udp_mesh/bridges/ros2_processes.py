"""ROS 2 as processes: a node that a test drives and the bridge, each robot in a ROS domain of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
from pathlib import Path
from typing import Any

from tests.udp_mesh.bridges.ros_processes import ROOT, stop
from tests.udp_mesh.daemon.processes import RunningDaemon, poll
from tests.udp_mesh.links.sockets import WAIT_S

PYTHON = ROOT / ".venv-ros2" / "bin" / "python"
"""The interpreter that scripts/setup-ros2 makes."""
NEEDS_ROS2 = "MESHCTL_TESTS_NEED_ROS2"


def expects_ros2() -> bool:
    """Whether tests of a real ROS 2 run: where it is installed, and where the environment says that it must be."""
    return PYTHON.exists() or bool(os.environ.get(NEEDS_ROS2))


def environment(domain: int) -> dict[str, str]:
    """One robot's ROS: nothing of another domain is heard, nothing leaves this machine."""
    return {
        **{name: text for name, text in os.environ.items() if not name.startswith(("ROS_", "RMW_", "PYTHON"))},
        "PYTHONPATH": str(ROOT),
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }


class Robot2:
    """A node of a robot; what it receives is collected."""

    def __init__(self, folder: Path, name: str, domain: int) -> None:
        self.name, self._log = name, folder / f"{name}-ros2.log"
        self._received: list[dict[str, Any]] = []
        self._lock = threading.Lock()
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                [str(PYTHON), str(Path(__file__).with_name("ros2_robot.py")), name],
                env=environment(domain),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        poll(lambda: self._take({"ready": True}), f"{name} starts: {self._log.read_text()}")

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._lock:
                self._received.append(json.loads(line))

    def _take(self, wanted: dict[str, Any]) -> dict[str, Any] | None:
        with self._lock:
            return next((line for line in self._received if wanted.items() <= line.items()), None)

    def _ask(self, **request: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()

    def publish(self, name: str, data: str, **qos: bool) -> None:
        self._ask(publish=name, data=data, **qos)

    def subscribe(self, name: str, **qos: bool) -> None:
        self._ask(subscribe=name, **qos)

    def count(self, data: str) -> int:
        with self._lock:
            return sum(line.get("data") == data for line in self._received)

    def expect(self, name: str, data: str) -> None:
        poll(lambda: self._take({"name": name, "data": data}), f"{data!r} on {name} at {self.name}")

    def publish_until(self, hearer: Robot2, name: str, data: str, **qos: bool) -> None:
        """Publish again and again: who subscribes is known only after a while."""

        def heard() -> dict[str, Any] | None:
            self.publish(name, data, **qos)
            return hearer._take({"name": name, "data": data})

        poll(heard, f"{data!r} on {name}")

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        stop(self.process, signal.SIGTERM)
        self._reader.join(WAIT_S)
        assert self.process.stdout is not None
        self.process.stdout.close()


class Bridge2:
    """One robot's bridge."""

    def __init__(self, daemon: RunningDaemon, domain: int) -> None:
        self._daemon, self._domain = daemon, domain
        self.log = daemon.folder / f"{daemon.name}-bridge2.log"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [str(PYTHON), "-m", "udp_mesh.bridges.ros2", "--socket", str(self._daemon.socket)],
                env=environment(self._domain),
                stdout=log,
                stderr=subprocess.STDOUT,
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
