"""`meshctl inventory import device` reads real nodes over SSH: dropbear, ash, and what their `uci` has."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from meshctl.cli.main import build
from meshctl.inventory import load_fleet
from meshctl.render import render_node
from meshctl.render.compare import placeholder_secret
from meshlab.fleet import VirtualFleet
from tests.meshctl.interchange.devices import SSH_KEY
from tests.meshlab.conftest import factory_reset

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]


def run(fleet: VirtualFleet, device: str, *words: str) -> Result:
    lab = ("--lab", str(fleet.directory))
    return CliRunner().invoke(build("inventory"), ["inventory", "import", "device", device, *lab, *words])


@pytest.fixture(autouse=True)
def no_agent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("SSH_AUTH_SOCK", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))


def test_an_unknown_host_key_is_refused_until_its_fingerprint_is_given(fleet: VirtualFleet, tmp_path: Path) -> None:
    new = tmp_path / "made"
    refused = run(fleet, "box", "--new", str(new), "--country", "US")
    assert refused.exit_code != 0
    assert not new.exists()
    fingerprint = next(word for word in refused.output.split() if word.startswith("SHA256:"))
    wrong = run(fleet, "box", "--new", str(new), "--country", "US", "--fingerprint", "SHA256:wrong")
    assert wrong.exit_code != 0
    assert "expected SHA256:wrong" in wrong.output
    done = run(fleet, "box", "--new", str(new), "--country", "US", "--fingerprint", fingerprint, "--json")
    assert done.exit_code == 0, done.output
    made = load_fleet(new)
    node = made.nodes[json.loads(done.stdout)["node"]]
    assert node.host_keys[0].startswith("ssh-ed25519 ")
    assert str(node.address) == "192.168.1.1/24"


def test_a_node_of_19_07_is_read_with_its_rsa_key(fleet: VirtualFleet, tmp_path: Path) -> None:
    done = run(fleet, "old", "--new", str(tmp_path / "made"), "--country", "US", "--yes")
    assert done.exit_code == 0, done.output
    (node,) = load_fleet(tmp_path / "made").nodes.values()
    assert node.release.value == "19.07"
    assert node.host_keys[0].startswith("ssh-rsa ")


def test_a_node_that_meshctl_configured_comes_back_without_a_difference(fleet: VirtualFleet, tmp_path: Path) -> None:
    """The files are written as a provisioning leaves them, then read over SSH and rendered again."""
    box = fleet.node("box")
    key = ("--yes", "--country", "US")
    first = run(fleet, "box", "--new", str(tmp_path / "stock"), *key)
    assert first.exit_code == 0, first.output
    stock = (tmp_path / "stock" / "fleet.yaml").read_text(encoding="utf-8")
    (radio,) = next(iter(load_fleet(tmp_path / "stock").hardware.values())).radios
    mesh = f"{{ssid: found, band: {radio.band.value}, channel: 6, network: 192.168.1.0/24, mode: mesh}}"
    text = stock.replace("mesh: null", "mesh: main, tx_power_dbm: 17")
    text = text.replace("\nhardware:", f"\nmeshes:\n  main: {mesh}\n\nhardware:")
    path = tmp_path / "fleet.yaml"
    path.write_text(text.replace("ssh_keys: []", f'ssh_keys: ["{SSH_KEY}"]'), encoding="utf-8")
    ours = load_fleet(path)
    (node,) = ours.nodes.values()
    rendered = render_node(ours, node.name, placeholder_secret)
    try:
        for file in rendered.files:
            if not file.path.startswith("etc/dropbear/"):
                written = (
                    f"mkdir -p /{os.path.dirname(file.path)}; cat >/{file.path} <<'END'\n{file.content.decode()}END\n"
                )
                box.exec(written).check(f"write {file.path}")
        again = run(fleet, "box", "--new", str(tmp_path / "again"), "--yes", "--json")
        assert again.exit_code == 0, again.output
        found = json.loads(again.stdout)
        assert found["node"] == node.name
        assert found["extra_uci"] == {}
        assert found["differences"] == []
        back = load_fleet(tmp_path / "again").nodes[node.name]
        assert (back.address, back.meshes, back.radios[0].tx_power_dbm) == (node.address, ("found",), 17)
    finally:
        factory_reset(box)


def test_the_guide_brings_an_existing_mesh_under_meshctl(
    mesh: VirtualFleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The commands of docs/how-to/import-existing.md up to the plan, on a mesh that was set up by hand."""
    page = (ROOT / "docs" / "how-to" / "import-existing.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^    ```sh\n(.*?)^    ```", page, re.DOTALL | re.MULTILINE)
    commands = [line.split()[1:] for block in blocks for line in block.splitlines()]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MESHCTL_LAB", str(mesh.directory))
    ran = []
    for words in commands:
        if words[0] == "plan":
            continue
        # the test is no terminal that could confirm the fingerprint, and the nodes have no operator's key yet
        extra = ["--yes"] if words[:3] == ["inventory", "import", "device"] else []
        done = CliRunner().invoke(build(words[0]), [*words, *extra])
        assert done.exit_code in ((0, 1) if words[0] == "lint" else (0,)), (words, done.output)
        ran.append(words[0])
    assert ran == ["inventory", "inventory", "inventory", "lint", "render", "inventory"]
    fleet = load_fleet(tmp_path / "valley")
    assert {name: str(node.address.ip) for name, node in fleet.nodes.items()} == {
        "base": "10.42.0.1",
        "near": "10.42.0.2",
        "far": "10.42.0.3",
    }
    (found,) = fleet.meshes.values()
    assert (found.ssid, found.bssid, found.channel, found.mtu) == ("a team", "02:ca:fe:00:00:01", 6, 1536)
    assert [node.meshes for node in fleet.nodes.values()] == [(found.name,)] * 3
    assert len(fleet.hardware) == 1
    assert fleet.nodes["far"].label == "F1"
    assert (tmp_path / "lids.pdf").read_bytes().startswith(b"%PDF-")
