"""`meshctl metrics`: one snapshot of the fleet as Prometheus metrics, and the files for Prometheus and Grafana."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import InventoryPath, KeyFiles, Lab
from meshctl.cli.fleet_view import CONNECT_S, NoRobots, Timeout, collect, open_fleet_view
from meshctl.cli.monitor_history import HistoryFile
from meshctl.cli.output import echo, echo_error
from meshctl.cli.robots_context import AskSudo
from meshctl.errors import InputError


def metrics(
    textfile: Annotated[
        Path | None,
        typer.Option(
            "--textfile", metavar="FILE", help="Write to FILE (*.prom) for node_exporter's textfile collector."
        ),
    ] = None,
    store: HistoryFile = None,
    file_sd: Annotated[
        bool,
        typer.Option("--file-sd", help="Print radios' exporters and robots' daemons as targets for file_sd_configs."),
    ] = False,
    rules: Annotated[bool, typer.Option("--rules", help="Print the alert rules for Prometheus.")] = False,
    dashboard: Annotated[bool, typer.Option("--dashboard", help="Print the dashboard for Grafana.")] = False,
    inventory: InventoryPath = Path(),
    no_robots: NoRobots = False,
    timeout: Timeout = CONNECT_S,
    ask_sudo: AskSudo = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Print one snapshot of the fleet in Prometheus's text format; `meshctl monitor` serves the same at /metrics.

    With --store, the newest frame of a monitor's history is printed, and no device is queried.

    Exit code: 0 printed or written, 2 could not run.

    Example: meshctl metrics --textfile /var/lib/prometheus/node-exporter/meshctl.prom

    Example: meshctl metrics --rules > /etc/prometheus/rules.d/meshctl.yml
    """
    from meshctl.monitor import prometheus

    if sum((file_sd, rules, dashboard)) > 1:
        raise InputError("expected one of --file-sd, --rules and --dashboard")
    if textfile is not None:
        prometheus.check_textfile(textfile)
    if rules or dashboard:
        text = prometheus.alert_rules() if rules else prometheus.dashboard()
    elif file_sd:
        from meshctl.inventory import load_fleet

        fleet = load_fleet(inventory, environ=os.environ)
        text = prometheus.file_sd(fleet)
        for problem in prometheus.daemon_targets(fleet)[1]:
            echo_error(problem)
    elif store is not None:
        text = _of_history(store)
    else:
        text = _of_fleet(inventory, no_robots, timeout, ask_sudo, key, lab)
    if textfile is None:
        echo(text, nl=False)
    else:
        prometheus.replace_file(textfile, text)


def _of_history(path: Path) -> str:
    from meshctl.monitor.metrics import render_metrics
    from meshctl.monitor.store import FrameStore

    with FrameStore.open_running(path) as history:
        return render_metrics(history.latest(), history, time.time())


def _of_fleet(
    inventory: Path, no_robots: bool, timeout: float, ask_sudo: bool, key: list[Path] | None, lab: Path | None
) -> str:
    from meshctl.monitor.frame import frame_of
    from meshctl.monitor.metrics import render_metrics
    from meshctl.status import assess, preflight
    from meshctl.status.json_output import as_json

    with open_fleet_view(
        inventory, key=key, lab=lab, timeout=timeout, ask_sudo=ask_sudo, no_robots=no_robots
    ) as fleet_view:
        now_s = time.time()
        status = assess(collect(fleet_view), fleet_view.nodes, now_s, fleet_view.robots)
        checks = preflight(fleet_view.fleet, status)
        return render_metrics(frame_of(as_json(status), time_s=now_s, checks=checks))
