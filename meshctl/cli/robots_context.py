"""`RobotsContext`: the selected robots, connections and options that every `meshctl robots` command opens first.

`with_robots_context` adds the shared options to a command and opens the context. `run_on_each` works on all robots in
parallel; `run_journaled` also shows progress and writes the journal that `meshctl resume` reads.
"""

from __future__ import annotations

import getpass
import inspect
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.cli.context import (
    AsJson,
    InventoryPath,
    KeyFiles,
    Lab,
    Limit,
    Session,
    read_selection,
    session,
    with_options,
)
from meshctl.cli.journaled_run import JournaledRun, journaled_run, print_totals
from meshctl.cli.output import echo, echo_error
from meshctl.device.connection import Connection
from meshctl.errors import InputError, MeshctlError
from meshctl.fleet import Event, EventKind, Observer, Outcome, Result, Tee, outcome_of_error, run, silent
from meshctl.fleet.journal import RunRecord
from meshctl.inventory.edit import Editor, save
from meshctl.inventory.secrets import SecretStore
from meshctl.model import Fleet, Secret
from meshctl.nodes.collect import known_macs
from meshctl.nodes.slots import transfers_at_once
from meshctl.render.daemon import daemon_keys
from meshctl.robots.bundle import UNIT_TITLES, configuration
from meshctl.robots.collector_release import RadioKnowledge, own_radios
from meshctl.robots.connection import RobotConnector, selected_robots
from meshctl.robots.deploy import COLLECTOR_KEY, DeployOptions, Wheelhouse, claim, deploy, roll_back
from meshctl.robots.host import Host
from meshctl.robots.preconditions import computer_of
from meshctl.robots.wheels import stock_units

Robots = Annotated[
    list[str] | None, typer.Argument(help="Robots: names, patterns, groups, '!husky2', @FILE; default: all.")
]
Named = Annotated[list[str], typer.Argument(metavar="ROBOTS", help="Robots or patterns such as 'husky*'.")]
Wheels = Annotated[
    Path | None,
    typer.Option(
        "--wheels", metavar="DIR", help="Directory with the required wheels; default: download them with pip."
    ),
]
AskSudo = Annotated[
    bool, typer.Option("--ask-sudo", help="Prompt for the sudo password (or set MESHCTL_SUDO_PASSWORD).")
]
Wait = Annotated[int, typer.Option("--wait", min=2, metavar="S", help="Seconds a new release has to become healthy.")]

RobotTask = Callable[[Host, str], Outcome]
Parameters = Mapping[str, Any]

# systemd stops and starts two services (TimeoutStopSec, TimeoutStartSec of the units).
SERVICE_TIMEOUT_S = 240.0
COMMAND_PREFIX = "robots "
# Poll interval for a second Ctrl-C, which closes all connections.
_LEAVE_POLL_S = 0.25

# Shared options by the parameters of `open_robots_context`, in the order of the help.
_SHARED: dict[str, tuple[Any, Any]] = {
    "robots": (Robots, None),
    "limit": (Limit, None),
    # required: for commands that must not default to all robots
    "named": (Named, inspect.Parameter.empty),
    "inventory": (InventoryPath, Path()),
    "wheels": (Wheels, None),
    "wait_s": (Wait, 30),
    "ask_sudo": (AskSudo, False),
    "as_json": (AsJson, False),
    "key": (KeyFiles, None),
    "lab": (Lab, None),
}


@dataclass(frozen=True, slots=True)
class RobotsContext:
    """Everything open for one command: the selected `robots`; `wheels` is the directory given for them."""

    opened: Session
    connector: RobotConnector
    robots: tuple[str, ...]
    options: DeployOptions
    inventory: Path
    wheels: Path | None
    as_json: bool

    @property
    def fleet(self) -> Fleet:
        return self.options.fleet

    def with_fleet(self, fleet: Fleet, *, only_configuration: bool = False) -> RobotsContext:
        """The same context for a changed inventory. Raises InvalidInput and InputError if a daemon would reject it."""
        secrets = SecretStore(os.environ, Path(fleet.base)).get
        daemon_keys(fleet, secrets)
        for robot in self.robots:
            configuration(fleet, robot, secrets, stock_units())
        options = replace(self.options, fleet=fleet, secrets=secrets, only_configuration=only_configuration)
        return replace(self, options=options, connector=replace(self.connector, fleet=fleet))

    def run_on_each(
        self, work: RobotTask, observer: Observer = silent, say: Callable[[str], None] = echo_error
    ) -> dict[str, Outcome]:
        """Connect to the selected robots in parallel and run `work`. A second Ctrl-C closes all connections."""
        interrupt = self.opened.interrupt
        connections: list[Connection] = []
        ended = threading.Event()

        def run_robot(robot: str) -> Outcome:
            try:
                with self.connector.host(robot, opened=connections.append) as host:
                    return work(host, robot)
            except MeshctlError as error:
                return outcome_of_error(robot, error)

        def leave() -> None:
            while not ended.wait(_LEAVE_POLL_S):
                if interrupt.leaving:
                    for connection in tuple(connections):
                        connection.close()

        watchdog = threading.Thread(target=leave, name="leave", daemon=True)
        watchdog.start()
        try:
            with interrupt.on_signals(say):
                return run(
                    self.robots,
                    run_robot,
                    parallel=transfers_at_once(self.fleet.apply.parallel),
                    interrupt=interrupt,
                    observer=observer,
                )
        finally:
            ended.set()
            watchdog.join()

    def run_journaled(
        self, command: str, work: Callable[[RobotsContext], RobotTask], parameters: Mapping[str, object] | None = None
    ) -> JournaledRun:
        """`run_on_each` with progress and a journal entry `robots COMMAND`; `parameters` serve `meshctl resume`."""
        self.connector.require_a_computer(self.robots)
        plan = json.dumps({"robots": dict(parameters or {})})
        with journaled_run(self.opened, f"robots {command}", self.robots, plan=plan, as_json=self.as_json) as journaled:

            def keep(event: Event) -> None:
                if event.kind is EventKind.FINISHED and event.outcome is not None:
                    journaled.entry.finish_node(event.outcome)

            @contextmanager
            def step(robot: str, name: str, text: str) -> Iterator[None]:
                journaled.progress(Event(EventKind.STEP, robot, time.time(), f"{name} {text}".rstrip()))
                with journaled.entry.step(robot, name):
                    yield

            context = replace(self, options=replace(self.options, step=step))
            observer = Tee((journaled.progress, keep))
            journaled.outcomes.update(context.run_on_each(work(context), observer, journaled.progress.stopping))
        return journaled


@contextmanager
def open_robots_context(
    inventory: Path,
    robots: list[str] | None = None,
    *,
    limit: list[str] | None = None,
    key: list[Path] | None = None,
    lab: Path | None = None,
    ask_sudo: bool = False,
    wheels: Path | None = None,
    wait_s: int = 30,
    as_json: bool = False,
    changes_nothing: bool = False,
) -> Iterator[RobotsContext]:
    """Open a session and its context. Raises InvalidInput and InputError for a bad inventory or selection."""
    password = sudo_password(ask_sudo)
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=changes_nothing) as opened:
        yield robots_context(
            opened, inventory, robots, password, limits=limit, wheels=wheels, wait_s=wait_s, as_json=as_json
        )


def robots_context(
    opened: Session,
    inventory: Path,
    robots: list[str] | None,
    password: Secret | None,
    *,
    limits: list[str] | None = None,
    wheels: Path | None = None,
    wait_s: int = 30,
    as_json: bool = False,
) -> RobotsContext:
    """A context in an open session."""
    fleet = opened.fleet
    secrets = SecretStore(os.environ, Path(fleet.base)).get
    lab = "" if opened.lab is None else str(opened.lab.directory)
    connector = RobotConnector(fleet, opened.access, lambda: password, opened.owner, lab)
    selected = selected_robots(fleet, robots, read_selection, limits or ())
    first = selected if len(selected) <= transfers_at_once(fleet.apply.parallel) else ()
    options = DeployOptions(
        fleet,
        secrets,
        Wheelhouse(wheels, _cache()).wheels,
        time.time,
        wait_s,
        radios=_radios(opened),
        apart=frozenset(fleet.robots).difference(first),
    )
    return RobotsContext(opened, connector, selected, options, inventory, wheels, as_json)


def _radios(opened: Session) -> RadioKnowledge:
    """Known facts about radios, from the fleet's pins and the journal, for the robots' collectors."""

    def names() -> dict[str, str]:
        return known_macs(opened.fleet, opened.journal.last_known(opened.fleet.name))

    return RadioKnowledge(opened.trust.pinned, names)


def with_robots_context(
    *shared: str, changes_nothing: bool = False
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add these shared options to a command that takes a `context`, and open the context for it."""

    def opened(**given: Any) -> AbstractContextManager[RobotsContext]:
        given["changes_nothing"] = changes_nothing
        return open_robots_context(**{"robots" if name == "named" else name: value for name, value in given.items()})

    names = {*shared, "lab"}
    return with_options("context", opened, {name: option for name, option in _SHARED.items() if name in names})


def sudo_password(ask: bool) -> Secret | None:
    """The sudo password: prompted for with `ask`, else from MESHCTL_SUDO_PASSWORD, else None."""
    given = os.environ.get("MESHCTL_SUDO_PASSWORD", "")
    if ask:
        if not sys.stdin.isatty():
            raise InputError("not a terminal: cannot prompt for a password", hint="set MESHCTL_SUDO_PASSWORD")
        given = getpass.getpass("sudo password on the robots: ")
    return Secret(given) if given else None


def _cache() -> Path:
    """Directory of downloaded wheels (XDG Base Directory 0.8)."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(named) if named.startswith("/") else Path(os.environ.get("HOME", "~")).expanduser() / ".cache"
    return root / "meshctl" / "wheels"


def finish(context: RobotsContext, journaled: JournaledRun, retry: str = "run `meshctl resume`") -> typer.Exit:
    """Print the totals, and the hint `retry` if something is left; returns the exit to raise."""
    return print_totals(context.opened, journaled, as_json=context.as_json, unfinished="robots", retry=retry)


def run_command(
    context: RobotsContext, command: str, begun: Callable[[], None] = lambda: None, **parameters: Any
) -> JournaledRun:
    """Run a command on all robots of the context; `parameters` are journaled with it. `begun` is called once the run is
    in the journal, before the first robot."""
    parameters = {
        **parameters,
        "wait_s": context.options.wait_s,
        "wheels": str(context.wheels.resolve()) if context.wheels else "",
    }

    def task(opened: RobotsContext) -> RobotTask:
        begun()
        return _task_for(command, opened, parameters)

    journaled = context.run_journaled(command, task, parameters)
    _write_collector_keys(context, journaled.outcomes)
    return journaled


def _write_collector_keys(context: RobotsContext, outcomes: Mapping[str, Outcome]) -> None:
    """Write new public keys of collectors into the inventory, for the radios to accept."""
    new = {
        robot: key
        for robot, outcome in outcomes.items()
        if (key := outcome.facts.get(COLLECTOR_KEY, "")) and key != computer_of(context.fleet, robot).collector_key
    }
    if not new:
        return
    editor = Editor.open(context.inventory, environ=os.environ)
    for robot, key in new.items():
        editor.set(("robots", robot, "computer", "collector_key"), key)
    changes = editor.changes()
    save(changes)
    if not context.as_json:
        for change in changes:
            echo(f"{', '.join(new)}: collector_key written to {change.file}")
        radios = [node.name for robot in new for node in own_radios(context.fleet, context.fleet.robots[robot])]
        echo(f"let their radios accept it: meshctl provision {' '.join(radios)}")


def _task_for(command: str, context: RobotsContext, parameters: Parameters) -> RobotTask:
    match command:
        # topic and key changes are in the inventory already; a robot only needs a deploy
        case "deploy" | "topic" | "rotate-key":
            return lambda host, robot: deploy(host, robot, context.options)
        case "rollback":
            return lambda host, robot: roll_back(host, robot, context.options)
        case "restart" | "stop":
            return lambda host, robot: _service(host, robot, command)
        case "uninstall":
            return lambda host, robot: _remove(host, robot, purge=bool(parameters.get("purge")))
        case _:
            raise InputError(f"a run of `robots {command}` cannot be resumed", hint="run the command again")


def _service(host: Host, robot: str, verb: str) -> Outcome:
    with claim(host):
        states = host.run("service", verb, timeout_s=SERVICE_TIMEOUT_S).splitlines()
    states_text = [f"{UNIT_TITLES[unit]} is {state}" for unit, state in map(str.split, states)]
    return Outcome(robot, Result.DONE, ", ".join(states_text))


def _remove(host: Host, robot: str, *, purge: bool) -> Outcome:
    with claim(host):
        host.run("remove", "purge" if purge else "keep", timeout_s=SERVICE_TIMEOUT_S)
    return Outcome(robot, Result.DONE, "removed")


def resume_run(opened: Session, inventory: Path, record: RunRecord, *, as_json: bool) -> typer.Exit:
    """Run the command of an earlier run for its unfinished robots; returns the exit to raise."""
    command = record.command.removeprefix(COMMAND_PREFIX)
    parameters = json.loads(record.plan).get("robots", {}) if record.plan else {}
    able = {name for name, robot in opened.fleet.robots.items() if robot.computer is not None}
    names = [name for name in opened.journal.unfinished(record.id) if name in able]
    if not names:
        echo(f"run {record.id} is finished: nothing to resume")
        return typer.Exit()
    if command == "rotate-key":
        # each step needs all robots, and the inventory records the next one
        again = f"meshctl robots rotate-key {parameters.get('new_key', 'NEW_KEY')}"
        raise InputError(f"run {record.id} is a key rotation, which takes all robots", hint=f"continue with `{again}`")
    if not as_json:
        echo(f"resuming run {record.id} ({record.command}): {', '.join(names)}")
    wheels, wait_s = parameters.get("wheels", ""), int(parameters.get("wait_s", 30))
    context = robots_context(
        opened,
        inventory,
        names,
        sudo_password(False),
        wheels=Path(wheels) if wheels else None,
        wait_s=wait_s,
        as_json=as_json,
    )
    context = context.with_fleet(opened.fleet, only_configuration=command == "topic")
    return finish(context, run_command(context, command, **parameters))
