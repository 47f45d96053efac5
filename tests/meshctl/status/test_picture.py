"""Every picture of the mesh shows every node and marks what holds others."""

from __future__ import annotations

import json

import pytest

from meshctl.status.picture import FORMATS, Picture, directions
from meshctl.topology import observed_graph, report_of
from tests.meshctl.status.fleets import HEALTHY, NAMES


@pytest.mark.parametrize("form", list(FORMATS))
def test_each_picture_shows_every_node_and_marks_the_cut_vertex(form: str) -> None:
    reports = {name: report_of(name, one) for name, one in HEALTHY.items()}
    picture = Picture(
        "main",
        "base",
        observed_graph(reports.values()),
        directions(reports, NAMES),
        dict.fromkeys(HEALTHY, 1.0),
        {},
    )
    drawn = FORMATS[form](picture)
    assert all(name in drawn for name in HEALTHY)
    marks = {"table": "cut vertex: b01", "tree": "b01 *", "json": '"cuts_off"', "dot": '"b01" [shape=box]'}
    assert marks.get(form, "NetworkGraph") in drawn
    if form in ("json", "netjson"):
        json.loads(drawn)
