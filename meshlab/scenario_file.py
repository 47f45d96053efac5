"""A scenario as a YAML file: a radio environment (the keys of `propagation_file`, or a separate file) and events.

    ground: ground.yaml                      # beside this file; or nodes, walls, air, links here
    base: base                               # default: base
    duration_s: 300
    robots:
      rover1: {path: [[0, 10, 0], [60, 200, 0]]}        # [seconds, x, y], as in `udp-mesh sim` scenarios
    beacons:
      b01: {carried_by: rover1, drop_s: 40}
    incidents:
      - {at_s: 200, what: "off", who: b01}
    trial: {report_s: 1, route_s: 1, shadow_db: 3, shadow_m: 10}      # for `meshctl lab sweep`

docs/lab-ground.md describes the format.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from meshctl.inventory.yaml_entries import YamlEntry, parse_text, read
from meshlab import propagation_file
from meshlab.propagation import RadioEnvironment
from meshlab.scenario import Deployment, PowerEvent, Scenario, Trajectory, TrialSettings, trajectory

_ENVIRONMENT_KEYS = ("nodes", "walls", "air", "links")
_KEYS = (
    "name",
    "base",
    "ground",
    *_ENVIRONMENT_KEYS,
    "duration_s",
    "step_s",
    "robots",
    "beacons",
    "incidents",
    "trial",
)
# one day; a longer scenario is most likely a typo
_MAX_DURATION_S = 86_400.0


def load(path: Path) -> Scenario:
    """Read a scenario and its radio environment. Raises InvalidInput with every problem, each with its position."""
    return _scenario(read(path), path)


def parse(text: str, path: Path, ground: str | None = None) -> Scenario:
    """Like `load`, from the file's text; `path` is the file name in problems, and `ground` is relative to it, unless
    its text is given."""
    return _scenario(parse_text(text, str(path)), path, ground)


def ground_path(text: str, path: Path) -> Path | None:
    """The file that `ground` of a valid scenario names."""
    entry = parse_text(text, str(path)).mapping().get("ground")
    return path.parent / entry.text() if entry is not None and entry.is_present else None


def _scenario(root: YamlEntry, path: Path, ground: str | None = None) -> Scenario:
    keys = root.mapping(_KEYS, required=("duration_s", "robots"))
    environment = _environment(keys, path, ground)
    robots = {name: _trajectory(entry) for name, entry in keys["robots"].mapping().items()}
    stationary = {name for name in environment.positions if name not in robots}
    beacons = {
        name: drop
        for name, entry in keys["beacons"].mapping().items()
        if (drop := _deployment(name, entry, (*robots, *sorted(stationary)))) is not None
    }
    for name in sorted(robots.keys() & beacons.keys()):
        keys["beacons"].problem("nodes that are not robots", name)
    base = keys["base"].text("base")
    names = tuple(sorted({*environment.names, *robots, *beacons}))
    if base not in names:
        keys["base"].problem(f"one of {', '.join(names) or 'the nodes'}", repr(base))
    scenario = Scenario(
        name=keys["name"].text(path.stem),
        base=base,
        environment=environment,
        duration_s=keys["duration_s"].number(1.0, 1.0, _MAX_DURATION_S),
        step_s=keys["step_s"].number(1.0, 0.1, _MAX_DURATION_S),
        robots=robots,
        beacons=beacons,
        power_events=tuple(_power_events(keys["incidents"], names)),
        trial=_trial(keys["trial"]),
    )
    root.finish()
    return scenario


def _environment(keys: dict[str, YamlEntry], path: Path, ground: str | None) -> RadioEnvironment:
    """The file that `ground` names, extended and overridden by this file's nodes, walls, air and links."""
    own = propagation_file.environment_in(keys)
    if not keys["ground"].is_present:
        return own
    place = path.parent / keys["ground"].text()
    other = propagation_file.load(place) if ground is None else propagation_file.parse(ground, str(place))
    ends = {link.ends for link in own.links}
    return replace(
        other,
        positions={**other.positions, **own.positions},
        walls=(*other.walls, *own.walls),
        path_loss=own.path_loss if keys["air"].is_present else other.path_loss,
        links=(*(link for link in other.links if link.ends not in ends), *own.links),
    )


def _trajectory(entry: YamlEntry) -> Trajectory:
    """`{path: [[seconds, x, y], ...]}`."""
    keys = entry.mapping(("path",), required=("path",))
    rows = [item.row(3, "[seconds, x, y]") for item in keys["path"].items()]
    points = [(row[0], (row[1], row[2])) for row in rows if row]
    try:
        return trajectory(points)
    except ValueError as error:
        if keys["path"].is_present and all(rows):
            keys["path"].problem("[[seconds, x, y], ...] with increasing times", str(error))
        return Trajectory((0.0,), ((0.0, 0.0),))


def _trial(entry: YamlEntry) -> TrialSettings:
    keys, standard = entry.mapping(("report_s", "route_s", "shadow_db", "shadow_m")), TrialSettings()
    return TrialSettings(
        report_s=keys["report_s"].number(standard.report_s, 0.1, _MAX_DURATION_S),
        route_s=keys["route_s"].number(standard.route_s, 0.1, _MAX_DURATION_S),
        shadow_db=keys["shadow_db"].number(standard.shadow_db, 0.0, 30.0),
        shadow_m=keys["shadow_m"].number(standard.shadow_m, 0.1, 10_000.0),
    )


def _deployment(name: str, entry: YamlEntry, carriers: tuple[str, ...]) -> Deployment | None:
    keys = entry.mapping(("carried_by", "drop_s"), required=("carried_by", "drop_s"))
    by = keys["carried_by"].text(one_of=tuple(carrier for carrier in carriers if carrier != name))
    return Deployment(by, keys["drop_s"].number(0.0, 0.0, _MAX_DURATION_S)) if by else None


def _power_events(entry: YamlEntry, names: tuple[str, ...]) -> list[PowerEvent]:
    found = []
    for item in entry.items():
        keys = item.mapping(("at_s", "what", "who"), required=("at_s", "what", "who"))
        at_s = keys["at_s"].number(0.0, 0.0, _MAX_DURATION_S)
        what = keys["what"].text("off", ("off", "on"))
        node = keys["who"].text(one_of=names)
        found.append(PowerEvent(at_s, node, what == "on"))
    return found
