"""`meshctl render` and `meshctl diff` as a person runs them."""

from __future__ import annotations

import json
import stat
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from meshctl.cli.main import main
from meshctl.model import MASK

KEY = "correct horse battery"
INVENTORY = """\
meshctl: 1
fleet: small
country: US
operators: {ssh_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGxvb25zIGFyZSBhcXVhdGljIGJpcmRz bob"]}
hardware:
  rocket:
    board: ubnt,rocket-m
    profile: ubnt_rocket-m
    target: ath79/generic
    release: "23.05"
    lan_ports: [eth0]
    radios:
      radio0: {path: "pci0000:00/0000:00:00.0", band: 2g, rated_power_dbm: 30, max_drive_dbm: 28}
meshes:
  main:
    ssid: small
    bssid: 02:ca:fe:00:00:01
    band: 2g
    channel: 6
    encryption: psk2+ccmp
    key: {env: MESH_KEY}
    network: 10.42.0.0/24
defaults: {hardware: rocket}
nodes:
  base: {role: base, address: 10.42.0.1}
  b[01-03]: {role: beacon, address: {from: 10.42.0.11}}
"""


@pytest.fixture
def inventory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MESH_KEY", KEY)
    # a hook of git that runs the tests sets the last three
    for name in ("MESHCTL_INVENTORY", "GIT_DIR", "GIT_INDEX_FILE", "GIT_WORK_TREE"):
        monkeypatch.delenv(name, raising=False)
    folder = tmp_path / "fleet"
    folder.mkdir()
    (folder / "fleet.yaml").write_text(INVENTORY)
    monkeypatch.chdir(folder)
    return folder


@dataclass(frozen=True)
class Ran:
    """How a command ended, and what it said."""

    code: int
    out: str
    err: str


Run = Callable[..., Ran]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*arguments: str | Path) -> Ran:
        with pytest.raises(SystemExit) as ended:
            main([str(word) for word in arguments])
        text = capsys.readouterr()
        return Ran(int(ended.value.code or 0), text.out, text.err)

    return call


@pytest.mark.usefixtures("inventory")
def test_render_prints_every_node_with_its_key_masked(run: Run) -> None:
    ran = run("render")
    assert ran.code == 0
    assert [line for line in ran.out.splitlines() if line.startswith("### ")] == [
        f"### {name} (23.05)" for name in ("base", "b01", "b02", "b03")
    ]
    assert f"option key '{MASK}'" in ran.out
    assert KEY not in ran.out


def test_render_writes_only_the_selected_nodes(run: Run, inventory: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ran = run("render", "b0[12]", "base", "--inventory", inventory, "--out", out)
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.splitlines() == [f"{name}: {out / name}" for name in ("base", "b01", "b02")]
    wireless = out / "b01/etc/config/wireless"
    assert f"option key '{KEY}'" in wireless.read_text()
    assert stat.S_IMODE(wireless.stat().st_mode) == 0o600


@pytest.mark.usefixtures("inventory")
def test_render_reports_in_json_without_the_key(run: Run, tmp_path: Path) -> None:
    ran = run("render", "b01", "--json", "--imagebuilder", tmp_path / "ib")
    assert KEY not in ran.out
    report = json.loads(ran.out)
    (node,) = report["nodes"]
    assert (node["node"], node["release"], node["folder"]) == ("b01", "23.05", None)
    assert [file["path"] for file in node["files"] if file["mode"] == "0600"] == [
        "/etc/config/wireless",
        "/etc/dropbear/authorized_keys",
    ]
    (build,) = report["imagebuilder"]
    assert (build["name"], build["target"], build["profile"]) == ("rocket-23.05", "ath79/generic", "ubnt_rocket-m")
    assert build["calls"]["b01"] in (tmp_path / "ib/rocket-23.05/build.sh").read_text()


def test_an_image_whose_ports_may_be_dead_gets_a_warning(run: Run, inventory: Path, tmp_path: Path) -> None:
    text = INVENTORY.replace("[eth0]", "[eth0.1]")
    (inventory / "fleet.yaml").write_text(text)
    ran = run("render", "b01", "--imagebuilder", tmp_path / "ib")
    assert (ran.code, ran.err.count("\n")) == (0, 1)
    assert ran.err.startswith("warning: b01: eth0.1 may have no port in this image")
    assert run("render", "b01", "--out", tmp_path / "out").err == ""
    (inventory / "fleet.yaml").write_text(text.replace("[eth0.1]", "[eth0.1]\n    switch_vlans: {1: 3 0t}"))
    assert run("render", "b01", "--imagebuilder", tmp_path / "ib").err == ""
    written = (tmp_path / "ib/rocket-23.05/files/b01/etc/config/network").read_text()
    assert "option ports '3 0t'" in written


@pytest.mark.parametrize(("vlans", "message"), [("{0: 3 0t}", "1 to 4094"), ("{1: eth0}", "such as 3 0t")])
def test_an_invalid_switch_vlan_layout_is_rejected(run: Run, inventory: Path, vlans: str, message: str) -> None:
    (inventory / "fleet.yaml").write_text(INVENTORY.replace("[eth0]", f"[eth0]\n    switch_vlans: {vlans}"))
    ran = run("render", "b01")
    assert ran.code == 2
    assert "switch_vlans" in ran.err
    assert message in ran.err


@pytest.mark.usefixtures("inventory")
def test_a_node_that_does_not_exist_is_reported(run: Run) -> None:
    ran = run("render", "b9*")
    assert ran.code == 2
    assert ran.err.startswith("error: no node matches 'b9*'")


def test_a_missing_key_is_reported_with_its_place(run: Run, inventory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MESH_KEY")
    ran = run("render", "--inventory", inventory)
    assert ran.code == 2
    line = INVENTORY.splitlines().index("    key: {env: MESH_KEY}") + 1
    assert f"fleet.yaml:{line}:" in ran.err
    assert "meshes.main.key" in ran.err


def test_nothing_is_written_if_one_node_cannot_be_rendered(run: Run, inventory: Path, tmp_path: Path) -> None:
    text = INVENTORY.replace("b[01-03]: {", 'b[01-03]: {extra_uci: {wireless.radio9.rts: "1"}, ')
    (inventory / "fleet.yaml").write_text(text)
    ran = run("render", "--out", tmp_path / "out")
    assert ran.code == 2
    place = f"fleet.yaml:{INVENTORY.count(chr(10), 0, INVENTORY.index('b[01-03]')) + 1}:"
    # three nodes share the mistake; it is reported once
    assert ran.err.count(place) == 1
    assert not (tmp_path / "out").exists()


def test_diff_of_identical_inventories_prints_nothing(run: Run, inventory: Path) -> None:
    assert run("diff", inventory, inventory) == Ran(0, "", "")


def test_diff_names_each_change_and_needs_no_key(
    run: Run, inventory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MESH_KEY")
    other = tmp_path / "other.yaml"
    other.write_text(INVENTORY.replace("channel: 6", "channel: 11").replace("b[01-03]", "b[01-02]"))
    ran = run("diff", inventory, other)
    assert ran.code == 1
    change = "  /etc/config/wireless\n    ~ wireless.radio0.channel: '6' -> '11'\n"
    assert ran.out == f"base:\n{change}b01:\n{change}b02:\n{change}b03: removed\n"
    assert run("diff", inventory, "-i", other) == ran
    report = json.loads(run("diff", inventory, other, "--json").out)
    assert [(item["node"], item["change"]) for item in report["nodes"]] == [
        ("base", "changed"),
        ("b01", "changed"),
        ("b02", "changed"),
        ("b03", "removed"),
    ]


class TestRevisions:
    """Inventories out of git."""

    @pytest.fixture
    def repository(self, inventory: Path) -> Path:
        self.git(inventory, "init", "-q")
        self.commit(inventory, "first")
        (inventory / "fleet.yaml").write_text(INVENTORY.replace("channel: 6", "channel: 1"))
        self.commit(inventory, "second")
        return inventory

    @staticmethod
    def git(folder: Path, *arguments: str) -> str:
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false"]
        done = subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True)
        return done.stdout

    def commit(self, folder: Path, message: str) -> None:
        self.git(folder, "add", ".")
        self.git(folder, "commit", "-q", "-m", message)

    def test_a_revision_is_compared_with_the_work_tree(self, run: Run, repository: Path) -> None:
        (repository / "fleet.yaml").write_text(INVENTORY.replace("channel: 6", "channel: 11"))
        before = self.git(repository, "status", "--porcelain")
        ran = run("diff", "HEAD:fleet.yaml", repository)
        assert ran.code == 1
        assert "channel: '1' -> '11'" in ran.out
        assert self.git(repository, "status", "--porcelain") == before

    @pytest.mark.usefixtures("repository")
    def test_two_revisions_are_compared_by_root_and_relative_paths(self, run: Run) -> None:
        ran = run("diff", "HEAD~1:", "HEAD:./")
        assert ran.code == 1
        assert "channel: '6' -> '1'" in ran.out

    @pytest.mark.usefixtures("repository")
    @pytest.mark.parametrize(
        ("argument", "words"),
        [
            ("nothing:fleet.yaml", "error: nothing:fleet.yaml: no revision 'nothing' in "),
            ("HEAD", "hint: for a revision of git, add the path of the inventory in it, such as HEAD:./"),
            ("HEAD:gone.yaml", "no such file or directory in HEAD"),
            ("HEAD:../../etc/passwd", "no such file or directory in HEAD"),
        ],
    )
    def test_a_missing_revision_or_inventory_file_is_reported(self, run: Run, argument: str, words: str) -> None:
        ran = run("diff", argument, "fleet.yaml")
        assert ran.code == 2
        assert words in ran.err

    def test_an_invalid_inventory_is_reported_with_its_revision(self, run: Run, repository: Path) -> None:
        (repository / "fleet.yaml").write_text(INVENTORY.replace("channel: 6", "chanel: 6"))
        self.commit(repository, "third")
        ran = run("diff", "HEAD:fleet.yaml", repository)
        assert ran.code == 2
        assert "error: HEAD:fleet.yaml:" in ran.err

    def test_what_cannot_be_rendered_is_reported_with_its_revision(self, run: Run, repository: Path) -> None:
        # this release accepts RSA keys only
        (repository / "fleet.yaml").write_text(INVENTORY.replace('release: "23.05"', 'release: "19.07"'))
        self.commit(repository, "third")
        ran = run("diff", "HEAD:fleet.yaml", repository)
        assert ran.code == 2
        assert ran.err.startswith("error: HEAD:fleet.yaml:4:")
