"""ROS 2 as processes: a node that a test drives and the bridge, each robot in a ROS domain of its own."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

from benchmarks.link.laboratory import Laboratory
from tests.udp_mesh.bridges.bridge_processes import BridgeProcess, NodeProcess
from tests.udp_mesh.bridges.ros1_processes import ROOT
from tests.udp_mesh.daemon.processes import RunningDaemon

PYTHON = ROOT / ".venv-ros2" / "bin" / "python"
"""The interpreter that scripts/setup-ros2 makes."""
NEEDS_ROS2 = "MESHCTL_TESTS_NEED_ROS2"


def expects_ros2() -> bool:
    """Whether tests of a real ROS 2 run: where it is installed, and where the environment says that it must be."""
    return PYTHON.exists() or bool(os.environ.get(NEEDS_ROS2))


BUILDER = Path(__file__).with_name("build_ros2_messages.py")


def build_messages(source: Path, out: Path) -> None:
    """Builds a package of messages, for `built` below."""
    done = subprocess.run(
        [str(PYTHON), str(BUILDER), str(source), str(out)],
        env=environment(0),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def environment(domain: int, built: Path | None = None) -> dict[str, str]:
    """One robot's ROS: nothing of another domain is heard, nothing leaves this machine. `built` has messages."""
    more = {} if built is None else {"LD_LIBRARY_PATH": str(built / "lib")}
    packages = [ROOT, Path(__file__).with_name("ros2_packages"), *([] if built is None else [built / "python"])]
    return {
        **{name: text for name, text in os.environ.items() if not name.startswith(("ROS_", "RMW_", "PYTHON"))},
        **more,
        "PYTHONPATH": ":".join(map(str, packages)),
        "ROS_DOMAIN_ID": str(domain),
        # shared memory is outside of network namespaces, and a killed process leaves its segments locked there
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }


def hear_only_loopback(lab: Laboratory, place: int) -> None:
    """Fast DDS finds the nodes of one machine by multicast."""
    lab.run(place, ["ip", "link", "set", "lo", "up", "multicast", "on"])
    lab.run(place, ["ip", "route", "replace", "239.0.0.0/8", "dev", "lo"])


class Ros2Node(NodeProcess):
    """A node of a robot. `inside` goes before its command: what enters the robot's own network."""

    def __init__(
        self, folder: Path, name: str, domain: int, inside: Sequence[str] = (), built: Path | None = None
    ) -> None:
        command = [*inside, str(PYTHON), str(Path(__file__).with_name("ros2_robot.py")), name]
        super().__init__(command, environment(domain, built), folder / f"{name}-ros2.log")

    def publish(self, name: str, data: object, **more: object) -> None:
        self._command(publish=name, data=data, **more)

    def subscribe(self, name: str, **more: object) -> None:
        self._command(subscribe=name, **more)

    def request(self, kind: str, name: str, **more: object) -> None:
        """Any other request of `ros2_robot`."""
        self._command(**{kind: name}, **more)

    def is_available(self, name: str) -> bool:
        """Whether a service has a server in this robot's graph."""
        self._command(is_available=name)
        return bool(self.expect("of", name)["available"])


class Ros2Bridge(BridgeProcess):
    """One robot's bridge, with `configuration` as its file."""

    def __init__(
        self,
        daemon: RunningDaemon,
        domain: int,
        inside: Sequence[str] = (),
        configuration: str = "",
        *more: str,
        built: Path | None = None,
    ) -> None:
        super().__init__(daemon.folder / f"{daemon.name}-bridge2.log")
        self._socket, self._domain, self._inside, self._more = daemon.socket, domain, inside, more
        self._built = built
        self._file = daemon.folder / f"{daemon.name}-bridge2.yaml"
        self._file.write_text(configuration)

    def start(self) -> None:
        command = [str(PYTHON), "-m", "udp_mesh.bridges.ros2", "--socket", str(self._socket)]
        command += ["--config", str(self._file), *self._more]
        self._run([*self._inside, *command], environment(self._domain, self._built))
