"""`meshctl monitor`: watch the fleet over time, serve the page, show or write a recording.

No other command imports this module, and with it Starlette and uvicorn.
"""

from __future__ import annotations

import json
import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from starlette.applications import Starlette

from meshctl import __version__
from meshctl.cli.context import AsJson, InventoryPath, KeyFiles, Lab
from meshctl.cli.fleet_view import CONNECT_S, Direct, FleetView, NoRobots, Timeout, collect, open_fleet_view
from meshctl.cli.monitor_history import HistoryFile, history_path
from meshctl.cli.monitor_web import WebOptions
from meshctl.cli.output import echo, echo_json
from meshctl.cli.robots_context import AskSudo
from meshctl.errors import ExitCode, InputError
from meshctl.monitor.access import TOKEN_VARIABLE
from meshctl.monitor.actions import Actions
from meshctl.monitor.alarm_log import LoggedAlarm
from meshctl.monitor.feed import Feed
from meshctl.monitor.frame import Frame
from meshctl.monitor.hooks import AlarmHooks, HookSettings
from meshctl.monitor.meters import MeterReadings
from meshctl.monitor.metrics import render_metrics
from meshctl.monitor.page import recording_of, save_page
from meshctl.monitor.prometheus import TextfileWriter, check_textfile
from meshctl.monitor.recording_page import documents_of, scratch_for
from meshctl.monitor.replay import is_history, open_recordings
from meshctl.monitor.sampler import FrameSampler
from meshctl.monitor.serve import address_of, serve
from meshctl.monitor.serve import listen as listen_on
from meshctl.monitor.server import MonitorServer, PageSettings
from meshctl.monitor.shared_alarms import SharedAlarms
from meshctl.monitor.store import FrameStore
from meshctl.report.duration import duration
from meshctl.robots.local_daemon import socket_path
from meshctl.wording import counted

DEFAULT_PORT = 8765
# Alarms that wait for a slow hook when the monitor ends.
HOOK_CLOSE_S = 2.0
# With --once there is no later moment at which the others are reported.
ONCE_HOOK_CLOSE_S = 60.0
# A round that is under way when the monitor ends.
SAMPLER_CLOSE_S = 2.0
# Two machines' clocks differ by less.
FUTURE_S = 60.0
_SHELL_OPERATORS = frozenset("|&;<>()")
DEFAULT_DAYS = 7.0
DEFAULT_MB = 512


def monitor(
    interval: Annotated[
        float,
        typer.Option("--interval", min=1.0, max=3600, metavar="S", help="Seconds between two snapshots of the fleet."),
    ] = 5.0,
    listen: Annotated[
        str, typer.Option("--listen", metavar="ADDRESS", help="IP address to serve the page on.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="TCP port of the page; 0: any.")] = DEFAULT_PORT,
    token_file: Annotated[
        Path | None,
        typer.Option("--token-file", help=f"File with the token that the page needs; also ${TOKEN_VARIABLE}."),
    ] = None,
    tls_certificate: Annotated[Path | None, typer.Option("--tls-cert", help="Certificate chain, PEM.")] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", help="Its private key, PEM.")] = None,
    host_name: Annotated[
        list[str] | None, typer.Option("--host-name", help="Host name by which browsers may reach it; repeatable.")
    ] = None,
    allow_actions: Annotated[
        bool,
        typer.Option("--allow-actions", help="Let the page provision, reboot, and mark beacons, with confirmation."),
    ] = False,
    webhook: Annotated[str, typer.Option("--webhook", metavar="URL", help="POST each new alarm to URL as JSON.")] = "",
    hook: Annotated[
        str, typer.Option("--hook", metavar="COMMAND", help="Run for each new alarm, with its JSON as input.")
    ] = "",
    hook_level: Annotated[
        str, typer.Option("--hook-level", metavar="LEVEL", help="Lowest level for --webhook and --hook.")
    ] = "warning",
    textfile: Annotated[
        Path | None,
        typer.Option("--textfile", metavar="FILE", help="Also write metrics to FILE (*.prom) for node_exporter."),
    ] = None,
    store: HistoryFile = None,
    keep_days: Annotated[
        float,
        typer.Option(
            "--keep-days", min=0.01, max=36_500, metavar="DAYS", help="Remove older snapshots from the history."
        ),
    ] = DEFAULT_DAYS,
    max_mb: Annotated[
        int, typer.Option("--max-mb", min=16, metavar="MB", help="Maximum size of the history.")
    ] = DEFAULT_MB,
    once: Annotated[bool, typer.Option("--once", help="Take one snapshot, store and print it, and exit.")] = False,
    replay: Annotated[
        list[Path] | None,
        typer.Option(
            "--replay", metavar="FILE", help="Serve a history, or recordings of udp-mesh, instead; repeatable."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="With --replay: write one HTML file that needs no server."),
    ] = None,
    inventory: InventoryPath = Path(),
    no_robots: NoRobots = False,
    direct: Direct = False,
    timeout: Timeout = CONNECT_S,
    ask_sudo: AskSudo = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Watch the fleet and serve a page with the mesh, robots and alarms, live and recorded. Ctrl-C ends it.

    The page listens on this machine only. On another address it needs a TLS certificate or a token, which is generated
    and printed if none is given. It changes nothing without --allow-actions.

    Exit code: 0 ended by SIGTERM, 130 by Ctrl-C, 2 could not run; with --once that of `meshctl status`.

    Example: meshctl monitor

    Example: meshctl monitor --listen 192.168.1.5 --interval 2

    Example: meshctl monitor --replay run.sqlite --out run.html
    """
    web = WebOptions.checked(
        listen, port, token_file, tls_certificate, tls_key, host_name or (), allow_actions=allow_actions
    )
    if out is not None and not replay:
        raise InputError("--out needs --replay", hint="meshctl monitor --replay FILE --out run.html")
    if replay:
        unused = {
            "--once": once, "--allow-actions": allow_actions, "--store": store, "--webhook": webhook, "--hook": hook,
            "--textfile": textfile,
        }  # fmt: skip
        if given := [option for option, value in unused.items() if value]:
            raise InputError(f"--replay does not go with {', '.join(given)}")
        _replay(replay, out, web, as_json=as_json)
        return
    hook_settings = HookSettings(webhook, _words(hook), hook_level)
    if textfile is not None:
        check_textfile(textfile)
    with ExitStack() as stack:
        view = stack.enter_context(
            open_fleet_view(
                inventory, key=key, lab=lab, timeout=timeout, ask_sudo=ask_sudo, no_robots=no_robots, direct=direct
            )
        )
        history = stack.enter_context(_open_history(view, store, keep_days, max_mb))
        history.claim()
        _warn_of_future_frames(history)
        sampler = sampler_of(view, history, interval)
        hooks = AlarmHooks(hook_settings, view.fleet.name)
        stack.callback(hooks.close, ONCE_HOOK_CLOSE_S if once else HOOK_CLOSE_S)
        sampler.listeners.append(lambda frame, began: hooks.notify(began))
        if textfile is not None:
            sampler.listeners.append(TextfileWriter(textfile, history, lambda text: sampler.on_problem(text)))
        if once:
            sampler.on_problem = hooks.on_problem = _warn_on_standard_error
            raise typer.Exit(_look_once(sampler, as_json=as_json))
        watch = _Watch(sampler, as_json=as_json)
        hooks.on_problem = sampler.on_problem
        if (exchange := view.opened.journal.alarm_exchange(view.fleet.name)) is not None:
            history.on_action = exchange.send
            shared = SharedAlarms(exchange, history, on_change=watch.notify, on_problem=sampler.on_problem)
            stack.callback(shared.stop)
            shared.start()
        options = _shared_options(inventory, key or (), lab)
        raise typer.Exit(watch.run(web, options))


def _words(command: str) -> tuple[str, ...]:
    """A command line as words. Raises InputError, also for the operators of a shell, which would be arguments."""
    try:
        words = tuple(shlex.split(command))
        tokens = tuple(shlex.shlex(command, punctuation_chars=True))
    except ValueError as error:
        raise InputError(f"--hook: expected a command line, found {command!r}: {error}") from error
    if found := next((token for token in tokens if not set(token) - _SHELL_OPERATORS), ""):
        raise InputError(
            f"--hook: no shell runs the command, so {found!r} would be an argument",
            hint=f"use a shell: --hook {shlex.quote(f'sh -c {shlex.quote(command)}')}",
        )
    return words


def _warn_on_standard_error(text: str) -> None:
    if text:
        echo(f"warning: {text}", err=True)


def _open_history(view: FleetView, path: Path | None, keep_days: float, max_mb: int) -> FrameStore:
    """The history of this fleet."""
    if path is None:
        lab = view.opened.lab
        path = history_path(view.fleet.name, None if lab is None else lab.directory)
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise InputError(f"{path.parent}: cannot be created: {error.strerror}") from error
    return FrameStore.open(path, keep_days * 86400, max_mb << 20)


def _warn_of_future_frames(history: FrameStore) -> None:
    """New frames follow the newest one, so a clock that was ahead once makes all later times wrong."""
    newest = history.latest()
    ahead_s = 0.0 if newest is None else newest.time_s - time.time()
    if ahead_s > FUTURE_S:
        echo(
            f"warning: {history.path}: its newest snapshot is {duration(ahead_s)} ahead of this machine's clock, and "
            "new ones get later times still: check the clock, or name another file with --store",
            err=True,
        )


def _shared_options(inventory: Path, keys: Iterable[Path], lab: Path | None) -> list[str]:
    """The options by which another meshctl finds the same fleet."""
    options = ["--inventory", str(inventory.resolve())]
    for key in keys:
        options += ["--key", str(key)]
    return options if lab is None else [*options, "--lab", str(lab)]


def _look_once(sampler: FrameSampler, *, as_json: bool) -> int:
    began: list[LoggedAlarm] = []
    sampler.listeners.append(lambda frame, alarms: began.extend(alarms))
    frame = sampler.sample()
    if sampler.store.problem:
        echo(f"warning: not stored: {sampler.store.problem}", err=True)
    if as_json:
        echo_json(frame.json_text)
    else:
        _print_frame(frame, began)
    return int(frame.status.get("exit_code", ExitCode.COULD_NOT_RUN))


def sampler_of(view: FleetView, history: FrameStore, interval_s: float) -> FrameSampler:
    """A sampler of the whole fleet."""
    return FrameSampler(
        view.fleet,
        lambda: collect(view, show_progress=False),
        history,
        view.nodes,
        view.robots,
        interval_s=interval_s,
        traffic=view.collector.traffic,
        topic_classes={topic.name: topic.topic_class.value for topic in view.fleet.topics},
    )


def _print_frame(frame: Frame, began: Iterable[LoggedAlarm]) -> None:
    totals = frame.status.get("totals", {}).get("nodes", {})
    answering = totals.get("ok", 0) + totals.get("degraded", 0)
    expected = answering + totals.get("unreachable", 0)
    verdict = frame.document.get("verdict") or {}
    radios = f"{answering} of {counted(expected, 'radio')} answer"
    echo(f"{_clock(frame.time_s)} {verdict.get('text', 'not assessed')}: {radios}")
    for alarm in began:
        if alarm.level != "note":
            echo(f"{_clock(alarm.first_s)} {alarm.level}: {alarm.device or 'fleet'}: {alarm.text}")


def _clock(time_s: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(time_s))


class _Watch:
    """Samples in a thread, serves in the main one."""

    def __init__(self, sampler: FrameSampler, *, as_json: bool) -> None:
        self._sampler = sampler
        self._as_json = as_json
        self._feed = Feed()
        self._last_verdict = ""
        self._last_problem = ""
        sampler.listeners.append(self._report)
        sampler.on_problem = self._warn

    def notify(self) -> None:
        """Tell open pages that something other than a frame has changed."""
        self._feed.notify()

    def run(self, web: WebOptions, options: list[str]) -> ExitCode:
        """Until a signal."""
        sampler = self._sampler
        fleet = sampler.fleet
        settings = PageSettings(fleet.name, __version__, "live", sampler.interval_s, sampler.topic_classes)
        with TemporaryDirectory(prefix="meshctl-monitor.") as directory:
            actions = None
            if web.allow_actions:
                command = [sys.executable, "-P", "-m", "meshctl"]
                names = frozenset(node.name for node in fleet.managed())
                actions = Actions(command, options, lambda: names, Path(directory), time.time)
            thread = threading.Thread(target=sampler.run, name="sampler", daemon=True)
            readings = MeterReadings(socket_path(None), self._feed.notify)
            sampler.meters = readings.current
            threading.Thread(target=readings.run, name="meters", daemon=True).start()
            try:
                server = MonitorServer(sampler.store, self._feed, settings, web.rules, actions, render_metrics)
                server.streams.meters = readings.current
                return _serve(server.app(), web, self._feed, as_json=self._as_json, sampler=thread)
            finally:
                readings.stop()
                sampler.stop()
                if thread.is_alive():
                    # a radio that does not answer may hold it for longer; nothing is lost then
                    thread.join(SAMPLER_CLOSE_S)
                if actions is not None:
                    actions.close()

    def _warn(self, text: str) -> None:
        if text == self._last_problem:
            return
        self._last_problem = text
        if text:
            self._say({"event": "problem", "at_s": round(time.time(), 3), "text": text}, f"warning: {text}")

    def _report(self, frame: Frame, began: Iterable[LoggedAlarm]) -> None:
        """Changes since the previous frame: the verdict, and alarms that began."""
        self._feed.notify()
        self._warn(f"not stored: {self._sampler.store.problem}" if self._sampler.store.problem else "")
        verdict = frame.document.get("verdict") or {}
        text = str(verdict.get("text", "not assessed"))
        if text != self._last_verdict:
            self._last_verdict = text
            reasons = "; ".join(verdict.get("reasons", ()))
            event = {"event": "verdict", "at_s": frame.time_s, "go": verdict.get("go"), "text": text}
            self._say(event, f"{_clock(frame.time_s)} {text}{f': {reasons}' if reasons else ''}")
        for alarm in began:
            if alarm.level != "note":
                line = f"{_clock(alarm.first_s)} {alarm.level}: {alarm.device or 'fleet'}: {alarm.text}"
                self._say({"event": "alarm", **alarm.as_json()}, line)

    def _say(self, event: dict[str, object], line: str) -> None:
        # a pipe whose reader has left is no reason to stop watching
        with suppress(OSError):
            say(event, line, as_json=self._as_json)


def say(event: dict[str, object], line: str, *, as_json: bool) -> None:
    """One line for people, or one for scripts, at once also through a pipe."""
    if as_json:
        echo_json(json.dumps(event))
    else:
        echo(line)
    sys.stdout.flush()


def _serve(
    app: Starlette, web: WebOptions, feed: Feed, *, as_json: bool, sampler: threading.Thread | None = None
) -> ExitCode:
    """Serve until a signal."""
    listening = listen_on(web.host, web.port)
    address = address_of(listening, web.token, is_tls=web.certificate is not None)
    say({"event": "listening", "url": address}, f"page: {address}\nCtrl-C ends this", as_json=as_json)
    if sampler is not None:
        sampler.start()
    number = serve(app, listening, feed, web.certificate)
    return ExitCode.INTERRUPTED if number == signal.SIGINT else ExitCode.OK


def _replay(files: list[Path], out: Path | None, web: WebOptions, *, as_json: bool) -> None:
    """Serve recordings, or write them as one page."""
    with scratch_for(out) as directory, open_recordings(files, directory) as opened:
        for problem in opened.problems:
            echo(f"warning: {problem}", err=True)
        reports = documents_of(file for file in files if not is_history(file))
        settings = PageSettings(
            opened.fleet, __version__, "replay", opened.interval_s, opened.topic_classes, has_report=len(reports) > 0
        )
        if out is not None:
            try:
                size_bytes = save_page(recording_of(opened.store, settings.as_json(), reports), out, directory)
            except OSError as error:
                raise InputError(f"cannot write {out}: {error.strerror}") from error
            size = f"{size_bytes / 1e6:.1f} MB"
            say({"event": "written", "file": str(out), "bytes": size_bytes}, f"wrote {out} ({size})", as_json=as_json)
            return
        feed = Feed()
        app = MonitorServer(opened.store, feed, settings, web.rules, report=list(reports)).app()
        raise typer.Exit(_serve(app, web, feed, as_json=as_json))
