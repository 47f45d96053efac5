"""What Prometheus and Grafana need: alert rules, a dashboard, targets, and the textfile of node_exporter."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
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
    """Targets for Prometheus' file_sd_configs: the managed radios that have OpenWrt's exporter among their packages.

    The daemons of udp_mesh serve their metrics on loopback only, so they are no targets of another machine.
    """
    groups = [
        {
            "targets": [host_and_port(str(node.address.ip), EXPORTER_PORT)],
            "labels": {"fleet": fleet.name, "node": node.name, "role": node.role.value, "robot": node.robot},
        }
        for node in fleet.managed()
        if EXPORTER_PACKAGE in (*node.hardware.packages, *node.packages)
    ]
    return json.dumps(groups, indent=2) + "\n"


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
