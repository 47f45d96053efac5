"""A radio environment as a YAML file: `load` and `parse` read it, `dump` writes it so that it reads back equal.

    nodes: {base: [0, 0], b01: {at: [80, 0], tx_power_dbm: 33}}      # meters
    walls: [{a: [40, 10], b: [200, 10], loss_db: 40}]
    air: {exponent: 3.5}                                             # keys: `path_loss.PathLossModel`
    links: [{between: [base, b01], loss: 30%, loss_back: 5%}]        # keys: `spec.LinkSpec`

An explicit link does not depend on its nodes' positions. docs/lab-ground.md describes the format.
"""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from meshctl.inventory.yaml_entries import YamlEntry, parse_text, read
from meshctl.placement.ground import GROUND_KEYS, air_json, ground_in
from meshlab.propagation import RadioEnvironment
from meshlab.quality import TQ_MAX
from meshlab.spec import LinkSpec

FLEET_FILE = "ground.json"
"""A running fleet's radio environment, in its directory."""
_LINK_KEYS = tuple(item.name for item in fields(LinkSpec) if item.name not in ("a", "b"))


def load(path: Path) -> RadioEnvironment:
    """Read a radio environment. Raises InvalidInput with every problem found, each with file, line and column."""
    return _environment(read(path))


def parse(text: str, file: str) -> RadioEnvironment:
    """Like `load`, from the file's text; `file` is the file name in problems."""
    return _environment(parse_text(text, file))


def _environment(root: YamlEntry) -> RadioEnvironment:
    environment = environment_in(root.mapping((*GROUND_KEYS, "links")))
    if not root.is_present:
        root.problem("a mapping")
    root.finish()
    return environment


def environment_in(keys: dict[str, YamlEntry]) -> RadioEnvironment:
    """The radio environment of the entries `nodes`, `walls`, `air` and `links`, which collect the problems."""
    ground = ground_in(keys)
    links: dict[frozenset[str], LinkSpec] = {}
    for entry in keys["links"].items():
        link = _link(entry)
        if link is not None and link.ends in links:
            entry.problem("each pair once", f"{link.a}-{link.b} again")
        elif link is not None:
            links[link.ends] = link
    return RadioEnvironment(ground.positions, ground.walls, ground.air, (*links.values(),))


def _link(entry: YamlEntry) -> LinkSpec | None:
    keys = entry.mapping(("between", *_LINK_KEYS), required=("between",))
    ends = [item.text() for item in keys["between"].items()]
    if len(ends) != 2 or ends[0] == ends[1] or not all(ends):
        if keys["between"].is_present:
            keys["between"].problem("two different nodes")
        return None
    loss_back, signal_back = keys["loss_back"], keys["signal_back_dbm"]
    rate, broadcast = keys["rate_kbps"], keys["broadcast_kbps"]
    standard = LinkSpec(ends[0], ends[1])
    return LinkSpec(
        ends[0],
        ends[1],
        tq=keys["tq"].integer(standard.tq, 0, TQ_MAX),
        signal_dbm=keys["signal_dbm"].integer(standard.signal_dbm, -120, 30),
        delay_ms=keys["delay_ms"].number(standard.delay_ms, 0.0, 60_000.0),
        loss=keys["loss"].share(standard.loss),
        rate_kbps=rate.integer(1, 1, 10_000_000) if rate.is_present else None,
        up=keys["up"].flag(standard.up),
        loss_back=loss_back.share(0.0) if loss_back.is_present else None,
        signal_back_dbm=signal_back.integer(0, -120, 30) if signal_back.is_present else None,
        broadcast_kbps=broadcast.integer(1, 1, 10_000_000) if broadcast.is_present else None,
    )


def dump(environment: RadioEnvironment) -> str:
    """The environment as text that `parse` reads back equal; JSON, which is YAML, too."""

    def given(value: Any) -> dict[str, Any]:
        return {key: item for key, item in asdict(value).items() if item is not None}

    links = []
    for link in environment.links:
        keys = given(link)
        links.append({"between": [keys.pop("a"), keys.pop("b")], **keys})
    content = {
        "nodes": {name: given(place) for name, place in environment.positions.items()},
        "walls": [asdict(wall) for wall in environment.walls],
        "air": air_json(environment.path_loss),
        "links": links,
    }
    return json.dumps(content, indent=1) + "\n"
