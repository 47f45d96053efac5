"""Files for Prometheus and Grafana: alert rules, a dashboard, targets, and the textfile of node_exporter."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

from meshctl.errors import InputError, MeshctlError
from meshctl.model import Fleet
from meshctl.model.ip import host_and_port
from meshctl.monitor.alarm_log import LoggedAlarm
from meshctl.monitor.frame import Frame
from meshctl.monitor.metrics import render_metrics
from meshctl.monitor.store import FrameStore

# OpenWrt's exporter and its default port (openwrt/packages, utils/prometheus-node-exporter-lua)
EXPORTER_PACKAGE = "prometheus-node-exporter-lua"
EXPORTER_PORT = 9100


def alert_rules() -> str:
    """The alert rules, as a rule file of Prometheus."""
    return files(__package__).joinpath("alerts.yml").read_text(encoding="utf-8")


def dashboard() -> str:
    """The dashboard, as JSON that Grafana imports."""
    return files(__package__).joinpath("dashboard.json").read_text(encoding="utf-8")


def file_sd(fleet: Fleet) -> str:
    """Targets for Prometheus' file_sd_configs: the managed radios that have OpenWrt's exporter among their packages,
    and the robots' daemons if they serve metrics (`daemon_targets`)."""
    radios = [
        {
            "targets": [host_and_port(str(node.address.ip), EXPORTER_PORT)],
            "labels": {"fleet": fleet.name, "node": node.name, "role": node.role.value, "robot": node.robot},
        }
        for node in fleet.managed()
        if EXPORTER_PACKAGE in (*node.hardware.packages, *node.packages)
    ]
    daemons = [
        {"targets": [target], "labels": {"fleet": fleet.name, "robot": robot, "instance": robot}}
        for robot, target in daemon_targets(fleet)[0].items()
    ]
    return json.dumps([*radios, *daemons], indent=2) + "\n"


def daemon_targets(fleet: Fleet) -> tuple[Mapping[str, str], Sequence[str]]:
    """Robot -> where Prometheus finds the metrics of its daemon; and why robots have no such address, a line each.

    Daemons serve their metrics on loopback alone, so these are addresses of Prometheus's own machine. The base
    station's computer is taken for that machine. Another robot's address gets 127 as its first byte: its daemon's port
    is to be forwarded there, and adding robots changes no other target."""
    port = fleet.udp_mesh.metrics_port
    if port is None:
        return {}, ()
    targets: dict[str, str] = {}
    problems: list[str] = []
    # the base station first: its address is fixed
    for robot in sorted(fleet.robots.values(), key=lambda robot: not robot.is_base):
        if robot.computer is None:
            continue
        address = str(robot.computer.address.ip)
        if not robot.is_base and robot.computer.address.version == 6:
            problems.append(f"{robot.name} is no target: its address {address} is IPv6, which has one loopback address")
            continue
        local = "127.0.0.1" if robot.is_base else "127." + address.split(".", 1)[1]
        target = host_and_port(local, port)
        if (other := next((name for name, taken in targets.items() if taken == target), None)) is not None:
            problems.append(f"{robot.name} is no target: {target} is that of {other}")
            continue
        targets[robot.name] = target
    return targets, problems


class TextfileWriter:
    """A listener of the sampler that writes every frame's metrics to a file; `problem` says why it could not, also to
    `on_problem`."""

    def __init__(
        self,
        path: Path,
        store: FrameStore,
        on_problem: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.path = path
        self._on_problem = on_problem
        self.problem = ""
        self._store = store
        self._clock = clock

    def __call__(self, frame: Frame, began: Sequence[LoggedAlarm]) -> None:
        try:
            replace_file(self.path, render_metrics(frame, self._store, self._clock()))
        except MeshctlError as error:
            # no reason to miss a frame
            if str(error) != self.problem:
                self._on_problem(str(error))
            self.problem = str(error)
        else:
            self.problem = ""


def check_textfile(path: Path) -> None:
    """Raises InputError for a name that node_exporter's textfile collector does not read."""
    if path.suffix != ".prom":
        raise InputError(f"--textfile: expected a file name that ends in .prom, found {path}", hint=_TEXTFILE_HINT)


_TEXTFILE_HINT = "node_exporter reads no other files; without --textfile, `meshctl metrics` prints to standard output"


def replace_file(path: Path, text: str) -> None:
    """Write a file that others read at any time: they see the old text or the new one. Raises InputError.

    Readable by all, since node_exporter runs as a user of its own.
    """
    temporary = ""
    try:
        # node_exporter reads *.prom alone, so the temporary file needs another name
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".new", dir=path.parent)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        if temporary:
            with suppress(OSError):
                os.unlink(temporary)
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
