"""Recordings of the kill matrix: where a run continues, and the table that is put into docs/proof.md."""

from __future__ import annotations

import json
from pathlib import Path

from meshctl.device.deadman import version
from tests.meshctl.proof.__main__ import next_batch
from tests.meshctl.proof.matrix import filled, table

PAGE = Path(__file__).parents[3] / "docs" / "proof.md"
CASE = {"verb": "apply", "kind": "sever", "phase": "lock", "state": "old", "reachable": True, "resumed": True}


def test_a_run_continues_after_the_last_batch_of_the_present_script_in_its_file(tmp_path: Path) -> None:
    out = tmp_path / "proof.jsonl"
    done = [("apply", 1, version()), ("apply", 2, version()), ("apply", 9, "0"), ("kill", 5, version())]
    out.write_text("".join(json.dumps({"part": p, "batch": b, "version": v}) + "\n" for p, b, v in done))
    assert next_batch(out, "apply", 1) == 3
    assert next_batch(out, "kill", 4) == 9
    assert next_batch(out, "flash", 1) == 1


def test_a_row_says_with_which_script_its_cases_were_recorded() -> None:
    old, new = ({**CASE, "version": version} for version in ("9", "10"))
    head, line, *rows = table([new, old, new, {**new, "struck": False}])
    assert rows == [
        "| apply | sever | lock | 10 | 2 | 2 | 0 | 0 | 0 | 0 | 0 |",
        "| apply | sever | lock | 9 | 1 | 1 | 0 | 0 | 0 | 0 | 0 |",
    ]
    other = "| apply | power-cut | lock | 9 | 7 | 0 | 7 | 0 | 0 | 0 | 0 |"
    page = ["# Title", head, line, other, rows[1], "8 cases, 0 failed: 8 with version 9 of the dead-man script.", ""]
    assert filled("\n".join(page), table([new])).splitlines()[3:] == [
        other,
        rows[0].replace("| 2 | 2 |", "| 1 | 1 |"),
        "8 cases, 0 failed: 1 with version 10, 7 with version 9 of the dead-man script.",
    ]


def test_the_page_counts_the_cases_of_its_table() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert filled(page, []) == page
    assert "of the dead-man script" in page
