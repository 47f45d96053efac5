"""Of a long table of originators, a node sends the rows that describe its neighbors: scripts/observe.sh on busybox."""

from __future__ import annotations

import json
import random
import re
from dataclasses import replace

import pytest

from meshctl.device.observation import MeshNeighbor, Observation
from meshctl.device.parse import batctl
from meshctl.device.scripts import script
from meshctl.topology.reports import report_of
from tests.meshctl.device.sandbox import Sandbox

OWN_ROWS, OTHER_RADIO = "02:15:6d:00:00:01", "02:15:6d:00:00:02"


def table(count: int, *, seed: int = 1, quality: str = "tq") -> str:
    """As batctl prints it, with two neighbors. The second is the other radio of a node: it has no row of its own."""
    chance = random.Random(seed)
    rows: list[dict[str, object]] = []
    for number in range(count):
        mac = OWN_ROWS if number == 0 else f"02:15:6d:00:{1 + (number >> 8):02x}:{number & 255:02x}"
        best = chance.choice((OWN_ROWS, OTHER_RADIO))
        for hop in (OWN_ROWS, OTHER_RADIO):
            rows.append(
                {"hard_ifindex": 7, "hard_ifname": "mesh0", "orig_address": mac,
                 **({"best": True} if hop == best else {}), "last_seen_msecs": chance.randrange(9000),
                 "neigh_address": hop, quality: chance.randrange(1, 256)}
            )  # fmt: skip
    return json.dumps(rows, separators=(",", ":")) + "\n"


def sent(node: Sandbox, printed: str, *, near: str = "yes", status: int = 0) -> tuple[str, str, int]:
    """The table and the counts that the node sends, and the status of the section."""
    node.put("/harness/table", printed)
    node.put("/usr/sbin/batctl", f"#!/bin/sh\ncat /harness/table\nexit {status}\n", 0o755)
    functions = re.findall(r"^(?:near_)?originators\(\) .*?^}$", script("observe.sh"), re.MULTILINE | re.DOTALL)
    assert len(functions) == 2
    run = 'originators bat0 >/harness/sent; echo $? >/harness/status; echo "$COUNTS" >/harness/counts'
    node.run("sh", "-c", "\n".join((*functions, f"NEAR={near}", run)))
    found = [node.text(f"/harness/{name}") or "" for name in ("sent", "counts", "status")]
    return found[0], found[1].strip(), int(found[2])


@pytest.mark.parametrize("quality", ["tq", "throughput"])
@pytest.mark.parametrize("count", [60, 220])
def test_the_report_of_a_node_is_the_same(node: Sandbox, count: int, quality: str) -> None:
    printed = table(count, quality=quality)
    near, counts, status = sent(node, printed)
    everything, rows = (batctl.parse_originators_json(text, {}) for text in (printed, near))
    assert everything is not None
    assert rows is not None
    neighbors = tuple(MeshNeighbor(mac, "mesh0", 40) for mac in (OWN_ROWS, OTHER_RADIO))
    seen = Observation(asked_at_s=0.0, answered_at_s=1.0, neighbors=neighbors, originators=everything)
    assert report_of("b01", replace(seen, originators=rows)) == report_of("b01", seen)
    assert batctl.parse_originators_count(counts) == (count, count)
    assert set(rows) < set(everything)
    assert status == 0


def test_a_table_whose_neighbors_all_have_rows_of_their_own_is_sent_as_these_rows(node: Sandbox) -> None:
    printed = table(220).replace(OTHER_RADIO, OWN_ROWS)
    near, counts, _ = sent(node, printed)
    assert {row.mac for row in batctl.parse_originators_json(near, {}) or ()} == {OWN_ROWS}
    assert len(near) < 500
    assert batctl.parse_originators_count(counts) == (220, 220)


@pytest.mark.parametrize(
    ("printed", "near"),
    [(table(220), "''"), (table(20), "yes"), (table(220).replace('":"', '": "'), "yes"), ("x" * 9000 + "\n", "yes")],
    ids=["to an observation of everything", "short", "written otherwise", "no table"],
)
def test_any_other_table_is_sent_as_it_is(node: Sandbox, printed: str, near: str) -> None:
    text, counts, status = sent(node, printed, near=near)
    assert (text, counts, status) == (printed, "", 0)


def test_a_batctl_that_fails_gives_its_status_and_no_table(node: Sandbox) -> None:
    """batctl of 19.07 has no JSON."""
    assert sent(node, "", status=1) == ("", "", 1)
    assert sent(node, table(220), status=254) == ("", "", 254)
