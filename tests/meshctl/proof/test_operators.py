"""Two operators share a journal: the second one is refused, and a database that dies loses nothing."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests.meshctl.fleet.postgresql_server import expects_postgresql
from tests.meshctl.proof.wires import in_own_network

pytestmark = [
    pytest.mark.lab,
    pytest.mark.xdist_group("rigs"),
    pytest.mark.skipif(not expects_postgresql(), reason="there is no PostgreSQL server (scripts/setup-postgresql)"),
]


def test_two_operators_and_a_database_that_dies_midway(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[3]
    command = in_own_network(tmp_path, "operators")
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    both = {"n001": "done", "n002": "done"}
    assert report["bootstrap"] == both, report
    code, error = report["refused"]
    assert code == 1
    assert "nothing was changed: alice@" in error
    assert "(run 2) is changing n002" in error
    assert report["results"] == both, report
    assert "journal entries are kept on this computer" in report["notice"]
    by_run = {run["run"]: run for run in report["before"]}
    assert by_run[2]["state"] == "interrupted", "it ended, and did not come to say so"
    assert {run["run"]: run["state"] for run in report["merged"]} == {1: "2 done", 2: "2 done", 3: "could not run"}
    assert [(run["run"], run["owner"].partition("@")[0]) for run in report["after"]] == [
        (3, "bob"),
        (2, "alice"),
        (1, "alice"),
    ]
    assert report["check"] == 0
