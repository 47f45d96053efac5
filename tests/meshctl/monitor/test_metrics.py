"""The sizes of batman-adv's tables as metrics, from recorded observations: what is not known is no sample, never 0."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.device.observation import MeshTableSizes, Observation
from meshctl.model import RELEASES, Fleet
from meshctl.monitor.frame import Frame, frame_of
from meshctl.monitor.metrics import render_metrics
from meshctl.status.json_output import as_json
from meshctl.status.values import NoAnswer
from tests.meshctl.device.test_observe import RECORDED, observed
from tests.meshctl.status.fleets import HEALTHY, NOW, status_of, trio

ORIGINATORS = "batman_originator_count"
TRANSLATIONS = "batman_tg_count"


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return trio(tmp_path)


def table_samples(page: str) -> list[str]:
    """The samples of both families, without the labels that all have."""
    rows = [line for line in page.splitlines() if line.startswith((f"{ORIGINATORS}{{", f"{TRANSLATIONS}{{"))]
    assert all('{node="rover",batdev="bat0",' in row for row in rows), rows
    return [row.replace('node="rover",batdev="bat0",', "") for row in rows]


def samples_of(fleet: Fleet, rover: Observation) -> list[str]:
    status = as_json(status_of(fleet, {**HEALTHY, "rover": rover}))
    return table_samples(render_metrics(frame_of(status, time_s=NOW)))


@pytest.mark.parametrize("release", [release.value for release in RELEASES])
def test_each_release_gives_the_sizes_of_its_tables(fleet: Fleet, release: str) -> None:
    # of BATMAN_V's recording no multicast group is announced, which is known
    multicast = 0 if release == "25.12" else 2
    assert samples_of(fleet, observed(RECORDED / release / "mesh")) == [
        f'{ORIGINATORS}{{selected="false"}} 1',
        f'{ORIGINATORS}{{selected="true"}} 3',
        f'{TRANSLATIONS}{{type="multicast"}} {multicast}',
        f'{TRANSLATIONS}{{type="unicast"}} 7',
    ]


def test_a_node_alone_in_its_mesh_has_no_originator_and_its_translations_are_unknown(fleet: Fleet) -> None:
    assert samples_of(fleet, observed(RECORDED / "23.05" / "searching")) == [
        f'{ORIGINATORS}{{selected="false"}} 0',
        f'{ORIGINATORS}{{selected="true"}} 0',
    ]


@pytest.mark.parametrize("case", ["broken", "factory"])
def test_tables_that_no_tool_printed_give_no_sample(fleet: Fleet, case: str) -> None:
    assert samples_of(fleet, observed(RECORDED / "24.10" / case)) == []


def test_a_node_that_does_not_answer_gives_no_sample(fleet: Fleet) -> None:
    others = {name: one for name, one in HEALTHY.items() if name != "rover"}
    status = as_json(status_of(fleet, others, silent={"rover": NoAnswer("timed out")}))
    assert table_samples(render_metrics(frame_of(status, time_s=NOW))) == []


def test_a_frame_of_an_earlier_version_gives_no_sample() -> None:
    status = {"nodes": [{"name": "rover", "answers": True, "mesh_statistics": {"bat0": {"tx_bytes": 1}}}]}
    page = render_metrics(Frame.of({"time_s": NOW, "status": status}))
    assert 'batman_tx_bytes{node="rover",batdev="bat0"} 1' in page
    assert table_samples(page) == []


def test_a_counter_of_a_node_does_not_take_the_name_of_a_table(fleet: Fleet) -> None:
    counters = {"bat0": {"originator_count": 99, "tg_count": 99, "tx_bytes": 1}}
    rover = replace(HEALTHY["rover"], mesh_statistics=counters, mesh_tables={"bat0": MeshTableSizes(2, 1)})
    assert samples_of(fleet, rover) == [f'{ORIGINATORS}{{selected="false"}} 1', f'{ORIGINATORS}{{selected="true"}} 2']
