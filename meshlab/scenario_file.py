"""A mission as a YAML file: a ground (the keys of `ground_file`, or a file of its own) and what happens on it.

    ground: ground.yaml                      # beside this file; or nodes, walls, air, links here
    base: base                               # default: base
    duration_s: 300
    robots:
      rover1: {path: [[0, 10, 0], [60, 200, 0]]}        # [seconds, x, y], as in `udp-mesh sim` scenarios
    beacons:
      b01: {carried_by: rover1, drop_s: 40}
    incidents:
      - {at_s: 200, what: "off", who: b01}

docs/lab-ground.md explains all of it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from meshlab import propagation_file
from meshlab.propagation import Ground
from meshlab.scenario import Course, Drop, Incident, Mission, course
from meshlab.yaml_entries import Entry, entry_of, read

_GROUND_KEYS = ("nodes", "walls", "air", "links")
_KEYS = ("name", "base", "ground", *_GROUND_KEYS, "duration_s", "step_s", "robots", "beacons", "incidents")
# a day; a mission that is longer has a slip of the pen
_LONGEST_S = 86_400.0


def load(path: Path) -> Mission:
    """Read a mission and its ground. Raises InvalidInput with every problem found, each with file, line and column."""
    return _mission(read(path), path)


def parse(text: str, path: Path) -> Mission:
    """As `load`, from the file's text; `path` is the name that problems show and the place its `ground` lies beside."""
    return _mission(entry_of(text, str(path)), path)


def _mission(root: Entry, path: Path) -> Mission:
    keys = root.mapping(_KEYS, required=("duration_s", "robots"))
    ground = _ground(keys, path)
    robots = {name: _course(entry) for name, entry in keys["robots"].mapping().items()}
    standing = {name for name in ground.places if name not in robots}
    beacons = {
        name: drop
        for name, entry in keys["beacons"].mapping().items()
        if (drop := _drop(name, entry, (*robots, *sorted(standing)))) is not None
    }
    for name in sorted(robots.keys() & beacons.keys()):
        keys["beacons"].problem("nodes that are not robots", name)
    base = keys["base"].text("base")
    everybody = tuple(sorted({*ground.names, *robots, *beacons}))
    if base not in everybody:
        keys["base"].problem(f"one of {', '.join(everybody) or 'the nodes'}", repr(base))
    mission = Mission(
        name=keys["name"].text(path.stem),
        base=base,
        ground=ground,
        duration_s=keys["duration_s"].number(1.0, 1.0, _LONGEST_S),
        step_s=keys["step_s"].number(1.0, 0.1, _LONGEST_S),
        robots=robots,
        beacons=beacons,
        incidents=tuple(_incidents(keys["incidents"], everybody)),
    )
    root.finish()
    return mission


def _ground(keys: dict[str, Entry], path: Path) -> Ground:
    """The file that `ground` names; what this file says of nodes, walls, air and links is added or wins."""
    own = propagation_file.ground_in(keys)
    if not keys["ground"].is_there:
        return own
    other = propagation_file.load(path.parent / keys["ground"].text())
    ends = {link.ends for link in own.links}
    return replace(
        other,
        places={**other.places, **own.places},
        walls=(*other.walls, *own.walls),
        air=own.air if keys["air"].is_there else other.air,
        links=(*(link for link in other.links if link.ends not in ends), *own.links),
    )


def _course(entry: Entry) -> Course:
    """`{path: [[seconds, x, y], ...]}`."""
    keys = entry.mapping(("path",), required=("path",))
    rows = [item.row(3, "[seconds, x, y]") for item in keys["path"].items()]
    points = [(row[0], (row[1], row[2])) for row in rows if row]
    try:
        return course(points)
    except ValueError as error:
        if keys["path"].is_there and all(rows):
            keys["path"].problem("[[seconds, x, y], ...] with rising times", str(error))
        return Course((0.0,), ((0.0, 0.0),))


def _drop(name: str, entry: Entry, carriers: tuple[str, ...]) -> Drop | None:
    keys = entry.mapping(("carried_by", "drop_s"), required=("carried_by", "drop_s"))
    by = keys["carried_by"].text(one_of=tuple(one for one in carriers if one != name))
    return Drop(by, keys["drop_s"].number(0.0, 0.0, _LONGEST_S)) if by else None


def _incidents(entry: Entry, everybody: tuple[str, ...]) -> list[Incident]:
    found = []
    for item in entry.items():
        keys = item.mapping(("at_s", "what", "who"), required=("at_s", "what", "who"))
        at_s = keys["at_s"].number(0.0, 0.0, _LONGEST_S)
        what = keys["what"].text("off", ("off", "on"))
        who = keys["who"].text(one_of=everybody)
        found.append(Incident(at_s, who, what == "on"))
    return found
