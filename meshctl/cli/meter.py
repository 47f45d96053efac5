"""`meshctl meter`: when a robot should drop its next beacon, once a second."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.beacon_drop import BeaconDrop
from meshctl.cli.context import AsJson
from meshctl.cli.fleet_view import FleetView, collect, paint_of, with_fleet_view
from meshctl.cli.inventory_versions import BeaconStock
from meshctl.cli.live_screen import live_screen
from meshctl.cli.output import echo, echo_json
from meshctl.cli.voice import Voice
from meshctl.errors import ExitCode, InputError
from meshctl.nodes.link_snapshots import HopMargins, LinkPoller, assemble, own_radios
from meshctl.placement.margin import MAX_SHARED_HOPS, required_snr_db
from meshctl.placement.meter import Meter, Position, Reading
from meshctl.placement.reading import is_due_to_speak, line, page, reading_json, style_of, words
from meshctl.robots.local_daemon import DaemonError, LocalDaemon, socket_path
from meshctl.robots.position_facts import positions_in
from meshctl.suggest import did_you_mean
from meshctl.wording import join_limited

DEFAULT_LOAD_MBIT_S = 2.0
# Shorter ways between two positions are the noise of an odometry.
_HEADING_M = 3.0
# A position of the robot's daemon comes every two seconds while it drives.
_MAX_POSITION_AGE_S = 6.0


@with_fleet_view
def meter(
    fleet_view: FleetView,
    robot: Annotated[str, typer.Argument(help="The robot that carries the beacons, or a node that moves with it.")],
    load: Annotated[
        float,
        typer.Option("--load", min=0.01, metavar="MBIT_S", help="What the robot sends at the end of the path."),
    ] = DEFAULT_LOAD_MBIT_S,
    beacons: Annotated[
        int | None, typer.Option("--beacons", min=0, help="Beacons on board; default: those carried in the inventory.")
    ] = None,
    spacing: Annotated[
        float | None,
        typer.Option("--spacing", min=1.0, metavar="M", help="Usual distance between beacons, for the depth left."),
    ] = None,
    speak: Annotated[bool, typer.Option("--speak", help="Speak the advice with espeak-ng.")] = False,
    daemon: Annotated[
        Path | None,
        typer.Option("--socket", metavar="PATH", help="This machine's udp_mesh daemon; default: UDP_MESH_SOCKET."),
    ] = None,
    deploy: Annotated[
        str,
        typer.Option(
            "--deploy",
            metavar="ros1|ros2",
            help="At DROP NOW, send the robot a std_msgs/Bool on the topic deploy_beacon. IT DROPS A BEACON.",
        ),
    ] = "",
    count: Annotated[int | None, typer.Option("--count", min=1, metavar="N", help="Exit after N readings.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show a robot's link margin in large digits, and when it should drop its next beacon.

    Once a second it queries the robot's own radios and one relay in turn, over kept connections. The first query also
    asks every node for its addresses. Positions come from this machine's udp_mesh daemon, or from the lab.

    Exit code: 0 after --count readings, 2 could not run, 130 interrupted.

    Example: meshctl meter spot1 --speak

    Example: meshctl meter spot1 --json --count 1
    """
    local = LocalDaemon(socket_path(daemon))
    drop = BeaconDrop(local, robot, deploy) if deploy else None
    if drop is not None:
        drop.check()
    voice = Voice() if speak else None
    # a path of beacons soon has as many hops
    needed_db = required_snr_db(load, MAX_SHARED_HOPS)
    stock = BeaconStock(fleet_view.fleet, robot)
    poller = _poller_of(fleet_view, robot, stock)
    source = _ReadingSource(
        robot,
        poller,
        Meter(needed_db),
        HopMargins(needed_db),
        _Positions(fleet_view, robot, local),
        stock.count if beacons is None else lambda: beacons,
        spacing,
        fleet_view.opened.access.meter.totals,
        drop,
        voice,
    )
    if as_json or count is not None or not sys.stdout.isatty():
        shown = ""
        for reading in source.readings(count):
            echo_json(json.dumps(source.json(reading))) if as_json else echo(line(robot, reading))
            if source.sound_problem != shown:
                shown = source.sound_problem
                echo(shown or "the sound works again", err=True)
            if source.note:
                echo(source.note, err=True)
        if voice is not None:
            voice.wait()
        raise typer.Exit
    live_screen(source.step, partial(_draw, source), 1.0, sys.stdout)
    raise typer.Exit(ExitCode.INTERRUPTED)


def _poller_of(fleet_view: FleetView, robot: str, stock: BeaconStock) -> LinkPoller:
    """The robot's radios and their base, with the addresses of every node that answers or was seen before."""
    fleet = fleet_view.fleet
    own = own_radios(fleet, robot)
    if not own:
        known = [*fleet.robots, *fleet.nodes]
        if robot in known:
            raise InputError(f"{robot} has no managed radio: the meter needs one that moves with it")
        hint = did_you_mean(robot, known) or f"its robots are {join_limited(list(fleet.robots))}"
        raise InputError(f"{fleet.name} has no robot {robot!r}", hint=hint)
    base = fleet.base_of(own[0])
    if base is None:
        raise InputError(f"{fleet.name} has no node with the role base: the meter needs to know where paths end")
    if base in own:
        raise InputError(f"{robot} is the base: choose a robot that carries beacons")
    macs = collect(fleet_view, robots=()).macs
    return LinkPoller(fleet, fleet_view.opened.access, own, macs, base.name, time.time, stock.names)


@dataclass(slots=True)
class _Positions:
    """Where the robot is: from the lab, or from this machine's daemon, to which the robots send their positions."""

    fleet_view: FleetView
    robot: str
    daemon: LocalDaemon
    _anchor: Position | None = None
    _heading_rad: float | None = None

    def now(self) -> tuple[Position | None, float | None]:
        """The position, and the direction of the last meters."""
        position = self._from_lab() or self._from_daemon()
        if position is not None:
            if self._anchor is None:
                self._anchor = position
            elif math.dist(position, self._anchor) >= _HEADING_M:
                self._heading_rad = math.atan2(position[1] - self._anchor[1], position[0] - self._anchor[0])
                self._anchor = position
        return position, self._heading_rad

    def _from_lab(self) -> Position | None:
        lab = self.fleet_view.opened.lab
        if lab is None:
            return None
        places = lab.positions
        names = (self.robot, *(node.name for node in own_radios(self.fleet_view.fleet, self.robot)))
        return next(((*places[name], 0.0) for name in names if name in places), None)

    def _from_daemon(self) -> Position | None:
        try:
            known = positions_in(self.daemon.request("status"))
        except DaemonError:
            return None
        recent = (
            position for position in known if position.name == self.robot and position.age_s <= _MAX_POSITION_AGE_S
        )
        return next(((position.x_m, position.y_m, position.z_m or 0.0) for position in recent), None)


@dataclass(slots=True)
class _ReadingSource:
    """One reading a second, passed on to the daemon, the robot and the loudspeaker."""

    robot: str
    poller: LinkPoller
    meter: Meter
    margins: HopMargins
    positions: _Positions
    stock: Callable[[], int | None]
    spacing_m: float | None
    traffic: Callable[[], dict[str, int]]
    drop: BeaconDrop | None
    voice: Voice | None
    bytes_per_s: float | None = None
    _seen_s: float = 0.0
    _counted: tuple[float, int] | None = None
    _spoken: Reading | None = None
    _steps: int = 0
    note: str = ""

    def readings(self, count: int | None) -> Iterator[Reading]:
        """Readings at an interval of a second, from the first answer on."""
        done = 0
        while count is None or done < count:
            began = time.monotonic()
            yield self.step()
            done += 1
            if count is None or done < count:
                time.sleep(max(0.0, 1.0 - (time.monotonic() - began)))

    def step(self) -> Reading:
        """Ask, wait a moment for the answers, and judge."""
        self.poller.ask()
        # the first answers need connections; later ones take a fraction of a second
        deadline = time.monotonic() + (10.0 if not self._steps else 0.7)
        while self.poller.own_taken_s() <= self._seen_s and time.monotonic() < deadline:
            if not self._steps and self.poller.problem():
                break
            time.sleep(0.02)
        self._steps += 1
        taken_s = self.poller.own_taken_s()
        fresh, self._seen_s = taken_s > self._seen_s, taken_s
        position, heading_rad = self.positions.now()
        snapshot = assemble(
            self.poller.mesh(),
            self.margins,
            time.time(),
            fresh=fresh,
            position=position,
            heading_rad=heading_rad,
            beacons=self.stock(),
            spacing_m=self.spacing_m,
        )
        reading = self.meter.step(snapshot)
        self._count_bytes()
        self._publish(reading)
        self._speak(reading)
        return reading

    def json(self, reading: Reading) -> dict[str, object]:
        return reading_json(self.robot, reading, self.bytes_per_s)

    @property
    def footer(self) -> str:
        """The airtime cost of the queries, and the latest problem."""
        cost = "?" if self.bytes_per_s is None else f"{self.bytes_per_s / 1000:.1f}"
        problem = self.poller.problem() or self.note or self.sound_problem
        return f"queries cost {cost} kB/s on the air; Ctrl-C to quit{f'; {problem}' if problem else ''}"

    def _count_bytes(self) -> None:
        now_s, total = time.monotonic(), sum(self.traffic().values())
        if self._counted is None:
            # the first query of all nodes and the key exchanges are over
            self._counted = (now_s, total)
        elif now_s - self._counted[0] >= 1.0:
            self.bytes_per_s = (total - self._counted[1]) / (now_s - self._counted[0])
            if now_s - self._counted[0] > 10.0:
                self._counted = (now_s, total)

    def _publish(self, reading: Reading) -> None:
        """The reading to local programs, and DROP NOW to the robot, once per change."""
        answers, self.note = True, ""
        try:
            self.positions.daemon.request("publish-meter", json.dumps(self.json(reading)).encode())
        except DaemonError as error:
            # without --deploy, it is enough that the reading is shown here
            answers, self.note = bool(error.code), str(error) if self.drop is not None else ""
        if self.drop is not None and (problem := self.drop.step(reading.advice, answers=answers)):
            self.note = f"{problem}; {self.note}" if self.note else problem

    @property
    def sound_problem(self) -> str:
        """Why the operator hears nothing; empty if the advice is heard, or is not to be spoken."""
        return "" if self.voice is None else self.voice.problem

    def _speak(self, reading: Reading) -> None:
        if self.voice is None or not is_due_to_speak(reading, self._spoken) or self.voice.is_speaking:
            return
        self._spoken = reading
        self.voice.say(words(reading))


def _draw(source: _ReadingSource, reading: Reading | None, size: os.terminal_size) -> list[str]:
    if reading is None:
        return ["querying the robot's radio ... (Ctrl-C to quit)"]
    lines = page(source.robot, reading, size.columns, source.footer)
    paint = paint_of()
    return [
        paint(text, style_of(reading.advice)) if number < len(lines) - 2 else text for number, text in enumerate(lines)
    ]
