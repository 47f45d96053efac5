"""Real ROS 1 masters, bridges and nodes for tests, each a process in ROS's own interpreter."""

from __future__ import annotations

import os
import re
import socket
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import udp_mesh
from tests.udp_mesh.bridges.bridge_processes import LOG_FOLDERS, BridgeProcess, NodeProcess, stop
from tests.udp_mesh.bridges.interpreters import ROS_PYTHON, older_interpreters
from tests.udp_mesh.daemon.processes import RunningDaemon, poll
from tests.udp_mesh.links.sockets import WAIT_S

ROOT = Path(udp_mesh.__file__).parent.parent
DEBIAN_PACKAGES = "/usr/lib/python3/dist-packages"
OLD_PYTHON = next(iter(older_interpreters(8)), ROS_PYTHON)
"""Python 3.8, which ROS Noetic was made for, where there is one: Debian's rospy is pure Python."""
ROBOT = Path(__file__).with_name("ros_robot.py")


def free_tcp_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Master:
    """One robot's roscore, and the environment of its nodes. `inside` goes before every command of this robot: where
    robots have networks of their own, what enters that one."""

    def __init__(self, folder: Path, name: str, inside: Sequence[str] = ()) -> None:
        self.name = name
        self.folder = folder
        LOG_FOLDERS.add(folder)
        self.inside = tuple(inside)
        self.port = free_tcp_port()
        self.log = folder / f"{name}-roscore.log"
        self.environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith(("ROS", "PYTHON", "VIRTUAL"))},
            "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(folder / f"{name}-ros"),
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONUNBUFFERED": "1",
        }
        self.process: subprocess.Popen[bytes] | None = None
        self._starts = 0

    def start(self, *, wait: bool = True) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*self.inside, "/usr/bin/roscore", "-p", str(self.port)],
                env=self.environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        self._starts += 1
        if wait:
            self.wait()

    def start_bare(self) -> None:
        """The master without roslaunch and rosout around it: a third of the work."""
        self.process = self.spawn(self.log.name, "/usr/bin/rosmaster", "--core", "-p", str(self.port))
        poll(self._answers, f"rosmaster: {self.log}")

    def _answers(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def wait(self) -> None:
        """Until it has started its own rosout too: before, it does not end in order."""
        poll(lambda: self.log.read_text().count("started core service") >= self._starts, f"roscore: {self.log}")

    def command(self, *words: str) -> str:
        """Runs a command of this robot to its end; what it prints."""
        done = subprocess.run(
            [*self.inside, *words], env=self.environment, capture_output=True, text=True, timeout=WAIT_S, check=False
        )
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        return done.stdout

    def spawn(self, log_name: str, *words: str) -> subprocess.Popen[bytes]:
        """Starts a program of this robot; what it prints is in `log_name`."""
        with (self.folder / log_name).open("ab") as log:
            return subprocess.Popen(
                [*self.inside, *words], env=self.environment, cwd=self.folder, stdout=log, stderr=subprocess.STDOUT
            )

    def stop(self) -> None:
        if self.process is not None:
            stop(self.process)
            self.process = None


class Ros1Node(NodeProcess):
    """A node in a robot's ROS graph."""

    def __init__(self, master: Master, name: str) -> None:
        super().__init__(
            [*master.inside, ROS_PYTHON, str(ROBOT), name],
            master.environment,
            master.folder / f"{master.name}-{name}.log",
        )

    def subscribe(self, name: str, type_name: str = "std_msgs/String", **more: object) -> None:
        """Waits until the subscriber is registered."""
        self._command(subscribe=name, type=type_name, **more)
        self.expect("subscribed", name)

    def stream(self, name: str, type_name: str, rate_hz: float, payload_bytes: int = 0, **more: object) -> None:
        """Publishes at this rate until `stop_streams`: images of so many bytes, or texts with number and time; with
        `picture` (width, height), whole images."""
        self._command(stream=name, type=type_name, rate_hz=rate_hz, bytes=payload_bytes, **more)

    def stop_streams(self) -> dict[str, int]:
        """How many messages each stream has published."""
        self._command(stop_streams=True)
        return dict(self.expect("streamed")["streamed"])

    def call(self, service: str) -> dict[str, Any]:
        """Calls a service without a request, as a program that was built with its package does."""
        self._command(call=service)
        return dict(self.expect("answer")["answer"])

    def serve(self, service: str, **more: object) -> None:
        """Serves made/Add until the node ends."""
        self._command(serve=service, **more)
        self.expect("serves", service)

    def add(self, service: str, a: int, b: int) -> None:
        """Calls made/Add; the answer follows as `added`."""
        self._command(add=service, a=a, b=b)

    def serve_action(self, name: str) -> None:
        """Serves actionlib's TestAction until the node ends."""
        self._command(serve_action=name)
        self.expect("serves_action", name)

    def goal(self, name: str, number: int) -> None:
        """Waits for the action's server and sends a goal; what follows is `feedback` and `ended`."""
        self._command(goal=name, number=number)

    def cancel(self, name: str) -> None:
        self._command(cancel=name)

    def exists(self, service: str) -> bool:
        self._command(exists=service)
        return bool(self.expect("exists")["exists"])

    def publish(self, name: str, data: object, type_name: str = "std_msgs/String", **more: object) -> int:
        """Publishes; returns how many subscribers were connected."""
        self._command(publish=name, type=type_name, data=data, **more)
        return int(self.expect("connections")["connections"])


class Ros1Bridge(BridgeProcess):
    """One robot's bridge, started by hand or by a launch file; `python` is its interpreter, where that is not ROS's."""

    def __init__(self, master: Master, daemon: RunningDaemon, python: str = ROS_PYTHON) -> None:
        super().__init__(master.folder / f"{daemon.name}-bridge.log")
        self._master, self._daemon = master, daemon
        self._python = python

    def start(self, *, launch: str = "", arguments: Sequence[str] = ()) -> None:
        """`launch` is a launch file's path; else the module is run."""
        if launch:
            # The legacy package, as a robot's workspace has it on its paths.
            legacy = self._master.folder / "workspace" / "udp_mesh"
            (legacy / "msg").mkdir(parents=True, exist_ok=True)
            (legacy / "__init__.py").touch()
            (legacy / "package.xml").write_text("<package><name>udp_mesh</name></package>")
            environment = {
                **self._master.environment,
                "ROS_PACKAGE_PATH": f"{legacy}:/usr/share",
                "PYTHONPATH": f"{legacy.parent}:{DEBIAN_PACKAGES}",
            }
            command = ["/usr/bin/roslaunch", launch]
        else:
            path = str(ROOT) if self._python == ROS_PYTHON else f"{ROOT}:{DEBIAN_PACKAGES}"
            environment = {**self._master.environment, "PYTHONPATH": path}
            command = [self._python, "-m", "udp_mesh.bridges.ros1", f"_socket:={self._daemon.socket}"]
        self._run([*self._master.inside, *command, *arguments], environment)

    def resident_bytes(self) -> int:
        assert self.process is not None
        return resident_bytes(self.process.pid)


def resident_bytes(pid: int) -> int:
    """Memory a process holds."""
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1]) * 1024
