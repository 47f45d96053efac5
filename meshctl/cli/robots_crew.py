"""What every `meshctl robots` command opens first: a `Crew` of chosen robots, the way to them, what they shall be."""

from __future__ import annotations

import getpass
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.session import Session, exit_for, progress_for, session
from meshctl.errors import InputError
from meshctl.fleet import Event, EventKind, Observer, Outcome, run, silent, totals
from meshctl.inventory.secrets import SecretStore
from meshctl.model import Fleet, Secret
from meshctl.render.daemon import daemon_config, daemon_keys
from meshctl.robots.deploy import Order, Wheelhouse, deploy
from meshctl.robots.host import Host
from meshctl.robots.reach import Reach, chosen_robots

Robots = Annotated[list[str] | None, typer.Argument(help="Robots, or patterns such as 'husky*'; default: all.")]
Wheels = Annotated[
    Path | None,
    typer.Option("--wheels", help="Directory with the wheels the robots need; without it pip downloads them here."),
]
AskSudo = Annotated[
    bool, typer.Option("--ask-sudo", help="Ask for the password that sudo wants (or set MESHCTL_SUDO_PASSWORD).")
]
Wait = Annotated[int, typer.Option("--wait", min=2, help="Seconds a daemon has to prove itself before it goes back.")]


@dataclass(frozen=True, slots=True)
class Crew:
    """Everything open for one command. `robots` are the chosen ones."""

    opened: Session
    reach: Reach
    robots: tuple[str, ...]
    order: Order
    as_json: bool

    @property
    def fleet(self) -> Fleet:
        return self.order.fleet

    def on_each(self, work: Callable[[Host, str], Outcome], observer: Observer = silent) -> dict[str, Outcome]:
        """Connect to every chosen robot and work there, several at once."""

        def one(robot: str) -> Outcome:
            with self.reach.host(robot) as host:
                return work(host, robot)

        with self.opened.interrupt.on_signals(lambda text: typer.echo(text, err=True)):
            return run(
                self.robots,
                one,
                parallel=self.fleet.apply.parallel,
                interrupt=self.opened.interrupt,
                observer=observer,
            )

    def deploy(self) -> dict[str, Outcome]:
        """Bring all of them to the inventory, showing it go on."""
        with progress_for(len(self.robots), as_json=self.as_json) as progress:

            def tell(robot: str, step: str) -> None:
                progress(Event(EventKind.STEP, robot, time.time(), step))

            order = replace(self.order, tell=tell)
            return self.on_each(
                lambda host, robot: deploy(host, robot, self.reach.computer(robot), order), observer=progress
            )

    def at(self, fleet: Fleet, *, only_configuration: bool = False) -> Crew:
        """The same crew under a (changed) inventory. Raises InvalidInput for what no daemon would take."""
        store = SecretStore(os.environ, Path(fleet.base))
        for robot in self.robots:
            daemon_config(fleet, robot)
        daemon_keys(fleet, store.get)
        order = replace(self.order, fleet=fleet, secrets=store.get, only_configuration=only_configuration)
        return replace(self, order=order, reach=replace(self.reach, fleet=fleet))


@contextmanager
def crew_of(
    inventory: Path,
    robots: list[str] | None,
    *,
    key: list[Path] | None,
    ask_sudo: bool = False,
    wheels: Path | None = None,
    wait_s: int = 30,
    as_json: bool = False,
) -> Iterator[Crew]:
    password = sudo_password(ask_sudo)
    with session(inventory, key_files=key or ()) as opened:
        fleet = opened.fleet
        order = Order(
            fleet,
            SecretStore(os.environ, Path(fleet.base)).get,
            Wheelhouse(wheels, _cache()).wheels,
            time.time,
            wait_s,
        )
        yield Crew(opened, Reach(fleet, opened.access, lambda: password), chosen_robots(fleet, robots), order, as_json)


def sudo_password(ask: bool) -> Secret | None:
    """From the environment, or asked for. Raises InputError where nobody can be asked."""
    given = os.environ.get("MESHCTL_SUDO_PASSWORD", "")
    if ask:
        if not sys.stdin.isatty():
            raise InputError("nobody can be asked for a password here", hint="set MESHCTL_SUDO_PASSWORD")
        given = getpass.getpass("sudo password on the robots: ")
    return Secret(given) if given else None


def _cache() -> Path:
    """XDG Base Directory 0.8: what can be fetched again."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(named) if named.startswith("/") else Path(os.environ.get("HOME", "~")).expanduser() / ".cache"
    return root / "meshctl" / "wheels"


def end(crew: Crew, outcomes: dict[str, Outcome]) -> typer.Exit:
    """Tell the totals; the exit to raise."""
    counted = totals(outcomes.values())
    if crew.as_json:
        from meshctl.report.progress import outcome_object

        told = [outcome_object(outcome) for outcome in outcomes.values()]
        typer.echo(json.dumps({"event": "ended", "totals": str(counted), "outcomes": told}))
    else:
        typer.echo(str(counted))
    return typer.Exit(exit_for(outcomes.values(), crew.opened.interrupt))
