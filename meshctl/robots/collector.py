"""The collector on a robot's computer: asks the robot's radios once a second, and tells the robot's daemon.

    python3 -m meshctl.robots.collector /opt/udp-mesh/current/etc/collector.json

`meshctl robots deploy` sends this module and what it imports, which is the standard library alone, and starts it beside
the daemon. A radio that does not answer is asked again, ever less often, and delays neither the other radio nor the
report: values that were measured before keep their age, and the daemon drops them.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from meshctl.device.link_table import LinkTable
from meshctl.robots.local_daemon import DaemonError, LocalDaemon, socket_path
from meshctl.robots.radio_report import Names, RadioTracker
from meshctl.robots.radio_session import OwnRadio, RadioError, RadioLogin, RadioSession, ssh_command

VERSION = 1
INTERVAL_S = 1.0
MAX_BACKOFF_S = 10.0
"""Longest pause after failures."""
BUSY_FACTOR = 5.0
"""A radio that answers slowly is asked so rarely that its answers take a fifth of its time."""
MAX_PAUSE_S = 5.0
NAMES_EVERY_S = 10.0
"""How often the file of names is looked at."""
_DONE, _NO_INPUT = 0, 2


class ConfigurationError(Exception):
    """The configuration cannot be read; names the file, and what was expected and found."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """The configuration that meshctl renders for one robot. `macs` are those of the inventory; `names` is the file of
    those that were observed: MAC -> node."""

    robot: str
    radios: tuple[OwnRadio, ...]
    robots: Mapping[str, tuple[str, ...]]
    login: RadioLogin
    names: Path
    macs: Mapping[str, str]
    load_mbit_s: float
    interval_s: float


def load(path: Path) -> Configuration:
    """Relative paths in the file are relative to its directory. Raises ConfigurationError."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["version"] != VERSION:
            raise ConfigurationError(f"{path}: expected version {VERSION}, found {document['version']!r}")
        return Configuration(
            robot=str(document["robot"]),
            radios=tuple(
                OwnRadio(str(radio["name"]), str(radio["host"]), int(radio["port"]), str(radio["user"]))
                for radio in document["radios"]
            ),
            robots={str(robot): tuple(map(str, nodes)) for robot, nodes in document["robots"].items()},
            login=RadioLogin(path.parent / document["key"], path.parent / document["known_hosts"]),
            names=path.parent / document["names"],
            macs={str(mac).lower(): str(node) for mac, node in document["macs"].items()},
            load_mbit_s=float(document["load_mbit_s"]),
            interval_s=float(document.get("interval_s", INTERVAL_S)),
        )
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from error
    except KeyError as error:
        raise ConfigurationError(f"{path}: expected the key {error}, found none") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise ConfigurationError(f"{path}: expected a collector's configuration: {error}") from error


class LinkSource(Protocol):
    """A source of a radio's link tables."""

    def ask(self) -> LinkTable:
        """Raises RadioError."""
        ...

    def close(self) -> None: ...


@dataclass(slots=True)
class RadioPoller:
    """Asks one radio at an interval in a thread, until it is stopped. `latest` and `problem` are read by others."""

    radio: OwnRadio
    session: LinkSource
    interval_s: float
    latest: LinkTable | None = None
    problem: str = ""
    _stop: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def start(self) -> None:
        self._thread = threading.Thread(target=self._run, name=f"radio-{self.radio.name}", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raises RuntimeError if the thread has failed: a new process asks again."""
        if self._thread is not None and not self._thread.is_alive():
            raise RuntimeError(f"the thread that asks {self.radio.name} has ended")

    def stop(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(MAX_PAUSE_S)

    def _run(self) -> None:
        failures = 0
        while not self._stop.is_set():
            began_s = time.monotonic()
            try:
                self.latest = self.session.ask()
                self.problem, failures = "", 0
            except RadioError as error:
                self.problem, failures = str(error), failures + 1
            took_s = time.monotonic() - began_s
            self._stop.wait(pause_s(self.interval_s, took_s, failures))
        self.session.close()


def pause_s(interval_s: float, took_s: float, failures: int) -> float:
    """Until a radio is asked again, after an answer (or `failures` attempts without one) that took so long."""
    if failures:
        return min(MAX_BACKOFF_S, interval_s * 2.0 ** min(failures - 1, 10))
    return max(0.0, min(MAX_PAUSE_S, max(interval_s, BUSY_FACTOR * took_s)) - took_s)


@dataclass(slots=True)
class LinkCollector:
    """Brings the tables of all radios together. `say` gets what changes, for the log."""

    configuration: Configuration
    pollers: Sequence[RadioPoller]
    daemon: LocalDaemon
    say: Callable[[str], None]
    _tracker: RadioTracker = field(init=False)
    _taken: dict[str, LinkTable] = field(default_factory=dict)
    _observed: Mapping[str, str] = field(default_factory=dict)
    _names_at_s: float | None = None
    _said: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._tracker = RadioTracker(self.configuration.load_mbit_s)

    def step(self, now_s: float) -> dict[str, Any]:
        """Report once; returns the report."""
        for poller in self.pollers:
            table = poller.latest
            if table is not None and self._taken.get(poller.radio.name) is not table:
                self._taken[poller.radio.name] = table
                self._tracker.take(poller.radio.name, table)
        problem = self._problem(now_s)
        source = " and ".join(poller.radio.name for poller in self.pollers)
        report = self._tracker.report(self._names(now_s), source[:63], problem, now_s)
        try:
            self.daemon.request("set-radio", json.dumps(report).encode())
            self._say_once("daemon", "")
        except DaemonError as error:
            self._say_once("daemon", daemon_problem(error))
        return report

    def _problem(self, now_s: float) -> str:
        problems = []
        for poller in self.pollers:
            name, reason = poller.radio.name, poller.problem
            text = f"{name} does not answer: {reason}" if reason else ""
            self._say_once(name, text)
            problems.append(text)
        if self._taken and not any(problems) and not self._names(now_s).nodes:
            problems.append("no radio is known by name: run `meshctl status`, then `meshctl robots deploy`")
        return "; ".join(text for text in problems if text)

    def _names(self, now_s: float) -> Names:
        if self._names_at_s is None or now_s - self._names_at_s >= NAMES_EVERY_S:
            self._names_at_s = now_s
            self._observed = self._read_names()
        return Names({**self.configuration.macs, **self._observed}, self.configuration.robots)

    def _read_names(self) -> Mapping[str, str]:
        """The observed names; those known before if the file cannot be read."""
        path = self.configuration.names
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            found = {str(mac).lower(): str(node) for mac, node in document.items()}
        except FileNotFoundError:
            found = {}
        except (OSError, ValueError, AttributeError) as error:
            self._say_once("names", f"{path}: {error}")
            return self._observed
        self._say_once("names", "")
        return found

    def _say_once(self, what: str, text: str) -> None:
        before = self._said.get(what)
        if text != before:
            self._said[what] = text
            if text or before:
                self.say(text or f"{what}: works again")


def daemon_problem(error: DaemonError) -> str:
    """For people: what is wrong, and what to do."""
    if error.code == "unknown-op":
        return "the daemon is older than this collector, and takes no radio values: run `meshctl robots deploy`"
    return f"the daemon does not take the values: {error}"


def collector(configuration: Configuration, daemon: LocalDaemon, say: Callable[[str], None]) -> LinkCollector:
    """A collector with a session for each radio."""
    pollers = [
        RadioPoller(radio, RadioSession(ssh_command(radio, configuration.login)), configuration.interval_s)
        for radio in configuration.radios
    ]
    return LinkCollector(configuration, pollers, daemon, say)


def run(
    configuration: Configuration,
    daemon: LocalDaemon,
    *,
    say: Callable[[str], None],
    show: Callable[[Mapping[str, Any]], None] = lambda report: None,
) -> None:
    """Report at the interval until an exception; `show` gets each report."""
    this = collector(configuration, daemon, say)
    for poller in this.pollers:
        poller.start()
    try:
        next_s = time.monotonic()
        while True:
            next_s = max(next_s + configuration.interval_s, time.monotonic())
            time.sleep(max(0.0, next_s - time.monotonic()))
            for poller in this.pollers:
                poller.check()
            show(this.step(time.monotonic()))
    finally:
        for poller in this.pollers:
            poller.stop()
        daemon.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """The service. Its log goes to standard error, and from there to the journal."""
    parser = argparse.ArgumentParser(
        prog="python3 -m meshctl.robots.collector",
        description="Report the measurements of the robot's radios to the udp_mesh daemon.",
    )
    parser.add_argument("configuration", type=Path, help="collector.json, as meshctl renders it")
    parser.add_argument("--socket", type=Path, help="the daemon's socket; default: UDP_MESH_SOCKET")
    given = parser.parse_args(arguments)

    def say(text: str) -> None:
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()

    # systemd's way to stop a service
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        run(load(given.configuration), LocalDaemon(socket_path(given.socket)), say=say)
    except ConfigurationError as error:
        say(str(error))
        return _NO_INPUT
    except KeyboardInterrupt:
        pass
    return _DONE


if __name__ == "__main__":
    sys.exit(main())
