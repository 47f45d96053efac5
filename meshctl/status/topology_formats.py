"""The mesh topology as table, tree, JSON, NetJSON NetworkGraph or DOT.

Links have the quality in both directions and the age of the reports; cut vertices are marked.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from meshctl.report import text_table
from meshctl.report.duration import duration
from meshctl.report.line_wrap import wrap
from meshctl.topology import Graph, Report, heard_by_name
from meshctl.topology.cells import LinkCell
from meshctl.wording import counted


@dataclass(frozen=True, slots=True)
class Direction:
    """One end's report of a link; all None if it did not answer."""

    quality: float | None = None
    signal_dbm: int | None = None
    age_ms: int | None = None


@dataclass(frozen=True, slots=True)
class TopologyView:
    """`directions[a, b]` is what `a` reports of hearing `b`, `cells[a, b]` in which cells; `ages_s` are the ages of the
    nodes' reports. `queried` are the selected nodes; None: all."""

    mesh: str
    # the base, and those of the other sites; empty without one
    entries: tuple[str, ...]
    graph: Graph
    directions: Mapping[tuple[str, str], Direction]
    ages_s: Mapping[str, float]
    addresses: Mapping[str, str]
    routing: str = "batman-adv"
    cells: Mapping[tuple[str, str], tuple[LinkCell, ...]] = field(default_factory=dict)
    queried: frozenset[str] | None = None

    @property
    def entry(self) -> str:
        return next(iter(self.entries), "")

    def was_queried(self, name: str) -> bool:
        return self.queried is None or name in self.queried

    def age_s(self, name: str) -> float | None:
        """The age of a node's report, rounded to milliseconds."""
        return round(self.ages_s[name], 3) if name in self.ages_s else None

    def cells_of(self, a: str, b: str) -> tuple[LinkCell, ...]:
        """The cells of a link, as reported by either end."""
        return tuple(dict.fromkeys((*self.cells.get((a, b), ()), *self.cells.get((b, a), ()))))

    def has_several_cells(self) -> bool:
        return len({cell.mesh for cells in self.cells.values() for cell in cells}) > 1

    def direction(self, a: str, b: str) -> Direction:
        return self.directions.get((a, b), Direction())


def directions(reports: Mapping[str, Report], macs: Mapping[str, str]) -> dict[tuple[str, str], Direction]:
    """Each reporting node's reports of the neighbors it heard recently."""
    return {
        (name, other): Direction(heard.quality, heard.signal_dbm, heard.last_seen_ms)
        for name, report in reports.items()
        for other, heard in heard_by_name(report, macs).items()
    }


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"


def table(view: TopologyView, width: int | None = None) -> str:
    """One line per link, weakest first; columns are left out, and notes wrapped, to fit `width`."""
    rows = []
    for link in sorted(view.graph.links, key=lambda link: (link.quality, link.a, link.b)):
        there, back = view.direction(link.a, link.b), view.direction(link.b, link.a)
        signals = "/".join("-" if d.signal_dbm is None else str(d.signal_dbm) for d in (there, back))
        ages = [d.age_ms for d in (there, back) if d.age_ms is not None]
        rows.append(
            (f"{link.a} -- {link.b}", _share(there.quality), _share(back.quality), signals,
             f"{max(ages)} ms ago" if ages else "-",
             "wired" if link.wired else ", ".join(map(str, view.cells_of(link.a, link.b))))
        )  # fmt: skip
    heading = ("link", "there", "back", "signal", "heard", "cell")
    links = text_table.lines(heading, rows, width, leave_out=("heard", "signal", "cell"))
    cut_off_by = view.graph.cut_off_by_any(view.entries)
    notes = [f"cut vertex: {name} (connects {', '.join(lost)})" for name, lost in cut_off_by.items()]
    return "\n".join([*links, *(part for note in notes for part in wrap(note, width))])


def tree(view: TopologyView, width: int | None = None) -> str:
    """Each node below its next hop to the entry; cut vertices are marked with a star. Without cells if they do not fit
    into `width`."""
    if width is not None and view.has_several_cells():
        whole = tree(view)
        if max(map(len, whole.splitlines()), default=0) > width:
            parts = [*tree(replace(view, cells={})).splitlines(), "cells not shown (use --json)"]
            return "\n".join(part for line in parts for part in wrap(line, width))
        return whole
    paths = view.graph.paths_to_any(view.entries)
    children: dict[str, list[str]] = {}
    for name, path in sorted(paths.items()):
        if path.hops:
            children.setdefault(path.via, []).append(name)
    cut_off_by = view.graph.cut_off_by_any(view.entries)
    lines: list[str] = []

    def label(name: str) -> str:
        star = " *" if name in cut_off_by else ""
        path = paths[name]
        text = "" if not path.hops else f"  {counted(path.hops, 'hop')}, {path.quality:.0%}"
        silent = ", does not answer" if view.was_queried(name) else ", not queried"
        age = f", {duration(view.ages_s[name])} old" if name in view.ages_s else silent
        if path.hops and view.has_several_cells():
            text += "".join(f", {cell}" for cell in view.cells_of(name, path.via))
        return f"{name}{star}{text}{age if path.hops else ''}"

    waiting = [(name, "", "") for name in reversed(view.entries) if name in paths and not paths[name].hops]
    while waiting:
        name, lead, below = waiting.pop()
        lines.append(f"{lead}{label(name)}")
        inner = children.get(name, [])
        for index in range(len(inner) - 1, -1, -1):
            last = index == len(inner) - 1
            waiting.append((inner[index], below + ("`- " if last else "|- "), below + ("   " if last else "|  ")))
    apart = [name for name in view.graph.nodes if name not in paths and view.was_queried(name)]
    # links that only other nodes report are missing
    among = "" if view.queried is None else " among the links that the selected nodes report"
    lines += [f"no path to {' or '.join(view.entries) or 'the base'}{among}: {', '.join(apart)}"] if apart else []
    lines += [f"* cut vertex{among}: others reach the base only through it"] if cut_off_by else []
    return "\n".join(lines)


def as_json(view: TopologyView) -> str:
    """Nodes, and links with both directions."""
    paths = view.graph.paths_to_any(view.entries)
    cut_off_by = view.graph.cut_off_by_any(view.entries)
    nodes: list[dict[str, Any]] = [
        {
            "name": name, "address": view.addresses.get(name), "age_s": view.age_s(name),
            "hops": paths[name].hops if name in paths else None,
            "quality": round(paths[name].quality, 4) if name in paths else None,
            "via": paths[name].via if name in paths and paths[name].hops else None,
            "cuts_off": list(cut_off_by.get(name, ())),
        }
        for name in view.graph.nodes
    ]  # fmt: skip
    links = [
        {
            "a": link.a, "b": link.b, "quality": round(link.quality, 4), "wired": link.wired,
            "cells": [
                {"mesh": cell.mesh, "band": cell.band.value, "channel": cell.channel}
                for cell in view.cells_of(link.a, link.b)
            ],
            "a_hears_b": _direction_json(view.direction(link.a, link.b)),
            "b_hears_a": _direction_json(view.direction(link.b, link.a)),
        }
        for link in view.graph.links
    ]  # fmt: skip
    return json.dumps({"mesh": view.mesh, "entry": view.entry, "nodes": nodes, "links": links}, indent=2)


def _direction_json(direction: Direction) -> dict[str, Any]:
    quality = None if direction.quality is None else round(direction.quality, 4)
    return {"quality": quality, "signal_dbm": direction.signal_dbm, "age_ms": direction.age_ms}


def netjson(view: TopologyView) -> str:
    """NetJSON NetworkGraph (netjson.org, draft 00): `cost` is 1 / quality, the expected transmissions."""
    return json.dumps(
        {
            "type": "NetworkGraph",
            "protocol": view.routing,
            # the draft's schema allows no null
            "version": "",
            "metric": "ETX",
            "label": view.mesh,
            "nodes": [
                {
                    "id": view.addresses.get(name, name),
                    "label": name,
                    "properties": {"age_s": view.age_s(name)},
                }
                for name in view.graph.nodes
            ],
            "links": [
                {
                    "source": view.addresses.get(link.a, link.a),
                    "target": view.addresses.get(link.b, link.b),
                    "cost": round(1.0 / max(link.quality, 1e-3), 4),
                    "properties": {"wired": link.wired},
                }
                for link in view.graph.links
            ],
        },
        indent=2,
    )


def dot(view: TopologyView) -> str:
    """Graphviz: cut vertices as boxes, quality as label and thickness."""
    cut_off_by = view.graph.cut_off_by_any(view.entries)
    lines = [f"graph {json.dumps(view.mesh)} {{"]
    for name in view.graph.nodes:
        shape = "doublecircle" if name in view.entries else "box" if name in cut_off_by else "ellipse"
        lines.append(f"  {json.dumps(name)} [shape={shape}];")
    for link in view.graph.links:
        style = (
            ' style="dashed"' if link.wired else f' label="{link.quality:.0%}" penwidth="{1 + 3 * link.quality:.1f}"'
        )
        lines.append(f"  {json.dumps(link.a)} -- {json.dumps(link.b)} [{style.strip()}];")
    return "\n".join([*lines, "}"])


FORMATS: dict[str, Callable[[TopologyView], str]] = {
    "table": table,
    "tree": tree,
    "json": as_json,
    "netjson": netjson,
    "dot": dot,
}
