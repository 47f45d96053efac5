"""Factory devices that all answer at one address, distinguished by the interface they are plugged into."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests.meshctl.proof.wires import WIRES, in_own_network

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("rigs")]


def test_two_devices_at_one_address_bootstrap_through_their_interfaces(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run(in_own_network(tmp_path), cwd=root, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["results"], report["check"]) == (dict.fromkeys(WIRES, "done"), 0), report
    assert report["names"] == {name: name for name in WIRES}
    assert report["addresses"] == {"n001": "10.42.1.1", "n002": "10.42.1.2"}
