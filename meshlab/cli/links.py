"""`meshctl lab link|move|ground|mission`: change the links of a running fleet."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.cli.context import AsJson, LabDirectory, lab_directory
from meshctl.cli.output import echo, echo_json
from meshctl.errors import ExitCode, InputError
from meshctl.inventory.yaml_entries import share_of
from meshlab import placement, propagation_file, scenario_file
from meshlab.fleet import VirtualFleet
from meshlab.propagation import RadioEnvironment, links_of
from meshlab.scenario import Event, EventKind
from meshlab.scenario_run import FleetTarget, play
from meshlab.spec import LinkSpec


def register(app: typer.Typer) -> None:
    """Add these commands to `app`."""
    app.command("link")(link)
    # negative coordinates must not be parsed as options
    app.command("move", context_settings={"ignore_unknown_options": True})(move)
    app.command("ground")(ground)
    app.command("mission")(mission)


def link(
    a: Annotated[str, typer.Argument(help="First node.")],
    b: Annotated[str, typer.Argument(help="Second node.")],
    up: Annotated[bool | None, typer.Option("--up/--down", help="Bring the link up or down.")] = None,
    loss: Annotated[str | None, typer.Option("--loss", help="Share of frames lost: 30% or 0.3.")] = None,
    one_way: Annotated[bool, typer.Option("--one-way", help="Apply the loss only to frames from A to B.")] = False,
    tq: Annotated[int | None, typer.Option("--tq", min=0, max=255, help="Maximum link quality, 0 to 255.")] = None,
    delay_ms: Annotated[float | None, typer.Option("--delay", min=0, help="One-way delay in milliseconds.")] = None,
    rate_kbps: Annotated[int | None, typer.Option("--rate", min=1, help="Rate in kbit/s.")] = None,
    broadcast_kbps: Annotated[
        int | None,
        typer.Option("--broadcast-rate", min=1, help="Rate of broadcasts in kbit/s, which share the link's time."),
    ] = None,
    directory: LabDirectory = None,
) -> None:
    """Change or add a link between two nodes; `meshctl lab mend A-B` undoes it.

    Example: meshctl lab link b01 b02 --loss 30% --one-way
    """
    share = None if loss is None else share_of(loss)
    if loss is not None and share is None:
        raise InputError(f"--loss: expected a share such as 30% or 0.3, found {loss!r}")
    if one_way and share is None:
        raise InputError("--one-way needs --loss")
    given = {
        "up": up,
        "loss_to_b" if one_way else "loss": share,
        "tq": tq,
        "delay_ms": delay_ms,
        "rate_kbps": rate_kbps,
        "broadcast_kbps": broadcast_kbps,
    }
    changes = {name: value for name, value in given.items() if value is not None}
    if not changes:
        raise InputError(
            f"nothing to change between {a} and {b}",
            hint="use --loss, --up, --down, --tq, --delay, --rate or --broadcast-rate",
        )
    fleet = VirtualFleet.attach(lab_directory(directory))
    fleet.link(a, b, **changes)
    for now in fleet.status()["links"]:
        if set(now["between"]) == {a, b}:
            echo(_changed_line(now))


def _changed_line(now: dict[str, Any]) -> str:
    """`b01 - b02: loss 30% there, 5% back, delay 20 ms, rate 256 kbit/s`"""
    a, b = now["between"]
    if not now["up"]:
        return f"{a} - {b}: down"
    delay = f", delay {now['delay_ms']:g} ms" if now["delay_ms"] else ""
    rate = f", rate {now['rate_kbps']} kbit/s" if now["rate_kbps"] else ""
    return f"{a} - {b}: loss {_loss_text(now['loss'], now['loss_back'])}{delay}{rate}"


def move(
    node: Annotated[str, typer.Argument(help="The node to move.")],
    x: Annotated[float, typer.Argument(help="Meters.")],
    y: Annotated[float, typer.Argument(help="Meters.")],
    directory: LabDirectory = None,
) -> None:
    """Move a node; its links follow from its new position, except those set with `meshctl lab link`.

    Example: meshctl lab move rover1 120 -40
    """
    fleet = VirtualFleet.attach(lab_directory(directory))
    placement.move(fleet, node, (x, y))
    for link_spec in links_of(placement.current_environment(fleet)):
        if node in link_spec.ends and link_spec.ends <= set(fleet.spec.names):
            echo(_link_line(link_spec.seen_from(node)))


def ground(
    file: Annotated[Path | None, typer.Argument(help="Positions, walls and links (YAML); default: show them.")] = None,
    directory: LabDirectory = None,
    as_json: AsJson = False,
) -> None:
    """Load node positions, walls and links for the fleet. Without FILE, show the current ones.

    Example: meshctl lab ground inventory/lab/ground.yaml
    """
    fleet = VirtualFleet.attach(lab_directory(directory))
    if file is not None:
        environment = propagation_file.load(file)
        if not set(environment.names) & set(fleet.spec.names):
            raise InputError(f"{file}: expected nodes of this fleet ({', '.join(fleet.spec.names)}), found none")
        placement.set_environment(fleet, environment)
    now = placement.current_environment(fleet)
    if as_json:
        echo(propagation_file.dump(now), nl=False)
        return
    _print_environment(now, fleet.spec.names)


def mission(
    file: Annotated[Path, typer.Argument(help="The mission (YAML).")],
    speed: Annotated[float, typer.Option("--speed", min=0.01, help="Replay speed; 2 is twice real time.")] = 1.0,
    start_s: Annotated[float, typer.Option("--from", min=0, help="Start at this mission time, in seconds.")] = 0.0,
    directory: LabDirectory = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print each event as one line of JSON.")] = False,
) -> None:
    """Replay a mission: robots drive along their waypoints and drop the beacons they carry.

    Carried beacons are off until they are dropped. Ctrl-C stops the replay and leaves the fleet as it is.

    Example: meshctl lab mission inventory/lab/mission.yaml --speed 10
    """
    scenario = scenario_file.load(file)
    if start_s >= scenario.duration_s:
        raise InputError(f"--from: expected less than the mission's {scenario.duration_s:g} s, found {start_s:g}")
    fleet = VirtualFleet.attach(lab_directory(directory))
    absent = sorted(set(scenario.names) - set(fleet.spec.names))
    if absent:
        echo(f"nodes of the mission that are not in this fleet: {', '.join(absent)}", err=True)
    report = _print_event_json if as_json else _print_event
    stopped_s = play(
        scenario,
        FleetTarget(fleet),
        on_event=report,
        clock=time.monotonic,
        wait=time.sleep,
        speed=speed,
        start_s=start_s,
    )
    if stopped_s is not None:
        echo(f"stopped at {stopped_s:.1f} s; the fleet stays as it is", err=True)
        echo(f"continue with: meshctl lab mission {file} --from {stopped_s:.1f}", err=True)
        raise typer.Exit(int(ExitCode.INTERRUPTED))


def _print_environment(now: RadioEnvironment, names: tuple[str, ...]) -> None:
    for name in names:
        place = now.positions.get(name)
        echo(f"{name} at {place.at[0]:g}, {place.at[1]:g} m" if place else f"{name} has no position")
    for link_spec in links_of(now):
        if link_spec.ends <= set(names):
            echo(_link_line(link_spec))


def _link_line(spec: LinkSpec) -> str:
    """`b01 - b02: loss 3% there, 5% back; TQ 247 there, 242 back, of 255`"""
    if not spec.up:
        return f"{spec.a} - {spec.b}: down"
    there, back = spec.loss_to(spec.b), spec.loss_to(spec.a)
    loss, qualities = _loss_text(there, back), f"{spec.tq_to(spec.b)} there, {spec.tq_to(spec.a)} back"
    return f"{spec.a} - {spec.b}: loss {loss}; TQ {qualities}, of 255"


def _loss_text(there: float, back: float) -> str:
    return f"{there:.0%}" if there == back else f"{there:.0%} there, {back:.0%} back"


_EVENT_TEXT = {
    EventKind.ARRIVES: "{who} arrives at {place}",
    EventKind.DROPPED: "{other} drops {who} at {place}",
    EventKind.OFF: "{who} is powered off",
    EventKind.ON: "{who} is powered on",
    EventKind.LINK_UP: "link {who} - {other} is up",
    EventKind.LINK_DOWN: "link {who} - {other} is down",
    EventKind.CUT_OFF: "{who} loses the base",
    EventKind.REACHED: "{who} reaches the base",
    EventKind.END: "the mission ends",
}


def _print_event(event: Event) -> None:
    place = "" if event.position is None else f"{event.position[0]:g}, {event.position[1]:g} m"
    echo(f"{event.at_s:8.1f} s  " + _EVENT_TEXT[event.kind].format(who=event.node, other=event.peer, place=place))


def _print_event_json(event: Event) -> None:
    content = {
        "at_s": event.at_s,
        "event": event.kind.value,
        "node": event.node,
        "other": event.peer or None,
        "place_m": event.position,
    }
    echo_json(json.dumps({key: value for key, value in content.items() if value is not None}))
