"""`meshctl lab link|move|ground|mission`: who hears whom in a running fleet, changed while it runs."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.cli.context import AsJson, LabDirectory, lab_directory
from meshctl.cli.output import echo, echo_json
from meshctl.errors import ExitCode, InputError
from meshlab import placement, propagation_file, scenario_file
from meshlab.fleet import VirtualFleet
from meshlab.propagation import Ground, links_of
from meshlab.scenario import Event, Happening
from meshlab.scenario_run import FleetStage, play
from meshlab.spec import LinkSpec
from meshlab.yaml_entries import share_of


def register(app: typer.Typer) -> None:
    """Make these commands of `app`."""
    app.command("link")(link)
    # coordinates may be negative, and are no options then
    app.command("move", context_settings={"ignore_unknown_options": True})(move)
    app.command("ground")(ground)
    app.command("mission")(mission)


def link(
    a: Annotated[str, typer.Argument(help="One node.")],
    b: Annotated[str, typer.Argument(help="The other.")],
    up: Annotated[bool | None, typer.Option("--up/--down", help="Whether they hear each other.")] = None,
    loss: Annotated[str | None, typer.Option("--loss", help="Share of frames lost: 30% or 0.3.")] = None,
    one_way: Annotated[bool, typer.Option("--one-way", help="The loss is of frames from A to B alone.")] = False,
    tq: Annotated[int | None, typer.Option("--tq", min=0, max=255, help="At most this link quality, of 255.")] = None,
    delay_ms: Annotated[float | None, typer.Option("--delay", min=0, help="Milliseconds one way.")] = None,
    rate_kbps: Annotated[int | None, typer.Option("--rate", min=1, help="Kilobit per second.")] = None,
    directory: LabDirectory = None,
) -> None:
    """Change a link between two nodes, or make one; `meshctl lab mend A-B` undoes it.

    Example: meshctl lab link b01 b02 --loss 30% --one-way
    """
    share = None if loss is None else share_of(loss)
    if loss is not None and share is None:
        raise InputError(f"--loss: expected a share such as 30% or 0.3, found {loss!r}")
    if one_way and share is None:
        raise InputError("--one-way says in which direction frames are lost, and needs --loss")
    given = {
        "up": up,
        "loss_to_b" if one_way else "loss": share,
        "tq": tq,
        "delay_ms": delay_ms,
        "rate_kbps": rate_kbps,
    }
    changes = {name: value for name, value in given.items() if value is not None}
    if not changes:
        raise InputError(
            f"nothing to change between {a} and {b}", hint="--loss, --up, --down, --tq, --delay, --rate say what"
        )
    fleet = VirtualFleet.attach(lab_directory(directory))
    fleet.link(a, b, **changes)
    for now in fleet.status()["links"]:
        if set(now["between"]) == {a, b}:
            echo(_set(now))


def _set(now: dict[str, Any]) -> str:
    """`b01 - b02: loses 30% there, 5% back, 20 ms later, at most 256 kbit/s`"""
    a, b = now["between"]
    if not now["up"]:
        return f"{a} - {b}: down"
    delay = f", {now['delay_ms']:g} ms later" if now["delay_ms"] else ""
    rate = f", at most {now['rate_kbps']} kbit/s" if now["rate_kbps"] else ""
    return f"{a} - {b}: loses {_lost(now['loss'], now['loss_back'])}{delay}{rate}"


def move(
    node: Annotated[str, typer.Argument(help="The node that moves.")],
    x: Annotated[float, typer.Argument(help="Metres.")],
    y: Annotated[float, typer.Argument(help="Metres.")],
    directory: LabDirectory = None,
) -> None:
    """Put a node elsewhere on the ground; its links follow from where it is, but for those set by hand.

    Example: meshctl lab move rover1 120 -40
    """
    fleet = VirtualFleet.attach(lab_directory(directory))
    placement.move(fleet, node, (x, y))
    for one in links_of(placement.ground_of(fleet)):
        if node in one.ends and one.ends <= set(fleet.spec.names):
            echo(_described(one.seen_from(node)))


def ground(
    file: Annotated[Path | None, typer.Argument(help="Places, walls and links (YAML); none: show the ground.")] = None,
    directory: LabDirectory = None,
    as_json: AsJson = False,
) -> None:
    """Put the fleet on a ground: who hears whom follows from its places, walls and links. Without FILE, show it.

    Example: meshctl lab ground inventory/lab/ground.yaml
    """
    fleet = VirtualFleet.attach(lab_directory(directory))
    if file is not None:
        wanted = propagation_file.load(file)
        if not set(wanted.names) & set(fleet.spec.names):
            raise InputError(f"{file}: expected nodes of this fleet ({', '.join(fleet.spec.names)}), found none")
        placement.stand_on(fleet, wanted)
    now = placement.ground_of(fleet)
    if as_json:
        echo(propagation_file.dump(now), nl=False)
        return
    _show(now, fleet.spec.names)


def mission(
    file: Annotated[Path, typer.Argument(help="The mission (YAML).")],
    speed: Annotated[float, typer.Option("--speed", min=0.01, help="So many times as fast as real time.")] = 1.0,
    start_s: Annotated[float, typer.Option("--from", min=0, help="Begin at this mission time, in seconds.")] = 0.0,
    directory: LabDirectory = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print each event as one line of JSON.")] = False,
) -> None:
    """Replay a mission: robots drive along their way points and drop the beacons they carry.

    Carried beacons are switched off at the start and on when they are dropped. Ctrl-C leaves everything as it is then.

    Example: meshctl lab mission inventory/lab/mission.yaml --speed 10
    """
    wanted = scenario_file.load(file)
    if start_s >= wanted.duration_s:
        raise InputError(f"--from: expected less than the mission's {wanted.duration_s:g} s, found {start_s:g}")
    fleet = VirtualFleet.attach(lab_directory(directory))
    absent = sorted(set(wanted.names) - set(fleet.spec.names))
    if absent:
        echo(f"not in this fleet: {', '.join(absent)}", err=True)
    say = _tell_json if as_json else _tell
    stopped_s = play(
        wanted, FleetStage(fleet), tell=say, clock=time.monotonic, wait=time.sleep, speed=speed, start_s=start_s
    )
    if stopped_s is not None:
        echo(f"stopped at {stopped_s:.1f} s; everything stays as it is", err=True)
        echo(f"go on with: meshctl lab mission {file} --from {stopped_s:.1f}", err=True)
        raise typer.Exit(int(ExitCode.INTERRUPTED))


def _show(now: Ground, names: tuple[str, ...]) -> None:
    for name in names:
        place = now.places.get(name)
        echo(f"{name} at {place.at[0]:g}, {place.at[1]:g} m" if place else f"{name} has no place")
    for one in links_of(now):
        if one.ends <= set(names):
            echo(_described(one))


def _described(one: LinkSpec) -> str:
    """`b01 - b02: loses 3% there, 5% back; quality 247 and 242 of 255`"""
    if not one.up:
        return f"{one.a} - {one.b}: down"
    there, back = one.loss_to(one.b), one.loss_to(one.a)
    lost, qualities = _lost(there, back), f"{one.tq_to(one.b)} there, {one.tq_to(one.a)} back"
    return f"{one.a} - {one.b}: loses {lost}; quality {qualities}, of 255"


def _lost(there: float, back: float) -> str:
    return f"{there:.0%}" if there == back else f"{there:.0%} there, {back:.0%} back"


_SAID = {
    Happening.ARRIVES: "{who} arrives at {place}",
    Happening.DROPPED: "{other} drops {who} at {place}",
    Happening.OFF: "{who} goes off",
    Happening.ON: "{who} comes on",
    Happening.LINK_UP: "{who} and {other} hear each other",
    Happening.LINK_DOWN: "{who} and {other} no longer hear each other",
    Happening.CUT_OFF: "{who} is cut off from the base",
    Happening.REACHED: "{who} reaches the base",
    Happening.END: "the mission ends",
}


def _tell(event: Event) -> None:
    place = "" if event.place is None else f"{event.place[0]:g}, {event.place[1]:g} m"
    echo(f"{event.at_s:8.1f} s  " + _SAID[event.what].format(who=event.who, other=event.other, place=place))


def _tell_json(event: Event) -> None:
    content = {
        "at_s": event.at_s,
        "event": event.what.value,
        "node": event.who,
        "other": event.other or None,
        "place_m": event.place,
    }
    echo_json(json.dumps({key: value for key, value in content.items() if value is not None}))
