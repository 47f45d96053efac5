"""`meshctl lab up` replaces the files of an earlier lab, and nothing else."""

from __future__ import annotations

import os
import re
import shutil
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from meshctl.cli.main import build
from meshctl.errors import ExitCode, InputError
from meshctl.fleet.lab_directory import INVENTORY, MARK, lab_of
from meshctl.inventory import load_fleet
from meshctl.inventory.secrets import SecretStore
from meshctl.resources import shipped
from meshlab import fleet_directory
from meshlab.control import address_of
from meshlab.errors import LabError
from meshlab.inventory_copy import copy_inventory

EXAMPLE = shipped("inventory") / "lab"


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A user's project with an inventory and folders that have the names of the lab's."""
    project = tmp_path / "project"
    shutil.copytree(EXAMPLE, project / "inventory")
    for name in ("rom", "nodes", "mnt", "log"):
        (project / name).mkdir()
        (project / name / "work.txt").write_text("weeks of work\n", encoding="utf-8")
    return project


def test_a_directory_with_other_files_is_refused_and_left_as_it_is(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(mine)
    monkeypatch.chdir(mine)
    for arguments in (["inventory", "--dir", "."], [".", "--dir", "."], [str(EXAMPLE), "--dir", str(mine)]):
        result = CliRunner().invoke(build("lab"), ["lab", "up", *arguments])
        assert result.exit_code == ExitCode.COULD_NOT_RUN, result.output
        assert contents(mine) == before
    with pytest.raises(LabError, match="expected an empty directory or one made by `meshctl lab up`"):
        copy_inventory(mine / "inventory", mine)


def test_a_fleet_with_19_07_gets_an_rsa_key_in_a_reused_lab_directory(tmp_path: Path) -> None:
    keys = []
    for example in (EXAMPLE, shipped("inventory") / "community", shipped("inventory") / "community"):
        copy = copy_inventory(example, tmp_path)
        keys.append(copy.key_file.with_name("operator.pub").read_text(encoding="ascii"))
        assert keys[-1].strip() in copy.fleet.operators.ssh_keys
    assert [key.split()[0] for key in keys] == ["ssh-ed25519", "ssh-rsa", "ssh-rsa"]
    assert keys[1] == keys[2]


def test_files_outside_the_inventory_are_still_found_from_the_copy(tmp_path: Path) -> None:
    """Two fleets in one repository share what is in `common`; one of its files names files beside itself."""
    project = tmp_path / "project"
    shutil.copytree(EXAMPLE, project / "north")
    (project / ".git").mkdir()
    for name in ("packages/a_1_all.ipk", "packages/b_1_all.ipk", "common/c_1_all.ipk", "common/box.bin", "common/key"):
        (project / name).parent.mkdir(exist_ok=True)
        (project / name).write_text(name, encoding="utf-8")
    (project / "parts/etc/config").mkdir(parents=True)
    (project / "parts/etc/config/mine.j2").write_text("config mine\n", encoding="utf-8")
    radio = "radio0: {path: p, band: 5g, rated_power_dbm: 20, max_drive_dbm: 20}"
    box = "board: a,b\n    profile: a_b\n    target: ath79/generic\n    release: '24.10'\n    lan_ports: [eth0]\n"
    box += f"    radios: {{{radio}}}\n"
    (project / "common/deep.yaml").write_text(
        "include: [../north/inside.yaml]\nhardware:\n  box:\n    package_files: [c_1_all.ipk]\n"
        f"    firmware: {{image: box.bin, usign_key: key}}\n    {box}",
        encoding="utf-8",
    )
    (project / "common/all.yaml").write_text("include: [deep.yaml]\n", encoding="utf-8")
    (project / "north/inside.yaml").write_text(
        f"hardware:\n  other:\n    package_files: &files [../packages/a_1_all.ipk, ../packages/b_1_all.ipk]\n    {box}"
        f"  same:\n    package_files: *files\n    {box}"
        "meshes:\n  far: {ssid: f, bssid: 02:ca:fe:00:00:0f, band: 5g, channel: 36, network: 10.9.0.0/24, "
        "backend: meshmerize,\n    operator_parts: {templates: ../parts, packages: [mm], interface: mm0}}\n",
        encoding="utf-8",
    )
    path = project / "north/fleet.yaml"
    path.write_text("include: [../common/all.yaml]\n" + path.read_text(encoding="utf-8"), encoding="utf-8")
    before = contents(project)
    fleet = copy_inventory(project / "north", tmp_path / "lab").fleet
    assert contents(project) == before
    assert fleet.hardware["same"].package_files == fleet.hardware["other"].package_files
    named = [*fleet.hardware["other"].package_files, *fleet.hardware["box"].package_files]
    firmware = fleet.hardware["box"].firmware
    found = [Path(fleet.base, file) for file in (*named, firmware.image, firmware.usign_key)]
    assert [file.read_text(encoding="utf-8") for file in found] == [
        *("packages/a_1_all.ipk", "packages/b_1_all.ipk", "common/c_1_all.ipk", "common/box.bin", "common/key")
    ]
    templates = Path(fleet.base, fleet.meshes["far"].operator_parts.templates)
    assert templates.is_relative_to(tmp_path / "lab" / INVENTORY)
    assert (templates / "etc/config/mine.j2").is_file()


def test_secrets_beside_the_inventory_are_still_found_from_the_copy(tmp_path: Path) -> None:
    project = tmp_path / "project"
    shutil.copytree(EXAMPLE, project / "inventory")
    (project / "secrets.yaml").write_text("mesh: outside\ntransport: outside, too\n")
    (project / "inventory/own.yaml").write_text("transport: inside\n")
    text = (project / "inventory/fleet.yaml").read_text()
    keys = "keys: [{file: own.yaml, key: transport}, {file: ../secrets.yaml, key: transport}]"
    text = re.sub(r"encryption: \w+", "encryption: psk2+ccmp\n    key: {file: ../secrets.yaml, key: mesh}", text)
    text, count = re.subn(r"\n  keys: .*", f"\n  {keys}", text)
    assert count == 1, text
    (project / "inventory/fleet.yaml").write_text(text)
    fleet = copy_inventory(project / "inventory", tmp_path / "lab").fleet
    store = SecretStore({}, Path(fleet.base))
    mesh = next(iter(fleet.meshes.values()))
    assert mesh.key is not None
    assert store.get(mesh.key).reveal() == "outside"
    assert [store.get(key).reveal() for key in fleet.udp_mesh.keys] == ["inside", "outside, too"]


def test_the_copy_does_not_lead_to_the_real_robots(tmp_path: Path) -> None:
    project = tmp_path / "project"
    shutil.copytree(shipped("inventory") / "subt-final", project)
    path = project / "fleet.yaml"
    text = path.read_text(encoding="utf-8")
    hosts = {"husky1": "husky1.example", "husky2": "10.9.8.7", "spot1": "127.0.0.9"}
    for robot, host in hosts.items():
        text = re.sub(rf"(\n  {robot}:.*?ssh: {{)", rf"\1host: {host}, ", text, count=1, flags=re.DOTALL)
    path.write_text(text, encoding="utf-8")
    copy = copy_inventory(project, tmp_path / "lab")
    kept = {name: robot.computer.ssh.host for name, robot in copy.fleet.robots.items() if robot.computer}
    assert (kept["husky1"], kept["husky2"], kept["spot1"]) == ("", "", "127.0.0.9")
    assert copy.hosts == ("husky1.example", "10.9.8.7")
    assert "husky1.example" in path.read_text(encoding="utf-8")
    # what the user sets in the copy, a test machine, stays
    edited = copy.inventory / "fleet.yaml"
    edited.write_text(edited.read_text(encoding="utf-8").replace('host: ""', "host: test.example", 1), encoding="utf-8")
    again = copy_inventory(copy.inventory, tmp_path / "lab")
    assert again.hosts == ()
    assert "host: test.example" in edited.read_text(encoding="utf-8")


def test_secrets_that_are_not_there_yet_are_expected_beside_the_copy(tmp_path: Path) -> None:
    project = tmp_path / "project"
    shutil.copytree(EXAMPLE, project / "inventory")
    first = project / "inventory/fleet.yaml"
    first.write_text(first.read_text().replace("{env: UDP_MESH_KEY}", "{file: ../keys.yaml, key: transport}"))
    fleet = copy_inventory(project / "inventory", tmp_path / "lab").fleet
    (tmp_path / "lab/keys.yaml").write_text("transport: made later\n")
    assert SecretStore({}, Path(fleet.base)).get(fleet.udp_mesh.keys[0]).reveal() == "made later"


def test_the_inventory_s_own_directory_is_refused(tmp_path: Path) -> None:
    project = tmp_path / "project"
    shutil.copytree(EXAMPLE, project)
    before = contents(project)
    with pytest.raises(LabError, match="found other files"):
        copy_inventory(project, project)
    (project / MARK).write_text("", encoding="utf-8")
    with pytest.raises(InputError, match="expected an inventory outside --dir"):
        copy_inventory(project, project)
    (project / MARK).unlink()
    assert contents(project) == before


def test_the_directory_of_a_running_fleet_is_left_unchanged(tmp_path: Path) -> None:
    copy_inventory(EXAMPLE, tmp_path)
    (tmp_path / "inventory" / "firmware.bin").write_bytes(b"image")
    (tmp_path / "inventory" / "known_hosts").write_text("b01 ssh-ed25519 AAAA\n", encoding="utf-8")
    before = contents(tmp_path)
    folder = os.open(tmp_path, os.O_RDONLY | os.O_DIRECTORY)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as supervisor:
        supervisor.bind(address_of(tmp_path, folder))
        # it never answers, as behind a machine whose kernel hangs
        supervisor.listen(1)
        with pytest.raises(LabError, match=r"runs in .* already"):
            copy_inventory(EXAMPLE, tmp_path)
    os.close(folder)
    assert contents(tmp_path) == before


def test_a_copy_that_was_edited_is_kept_beside_the_new_one(tmp_path: Path) -> None:
    first = copy_inventory(EXAMPLE, tmp_path)
    assert first.kept is None
    again = copy_inventory(EXAMPLE, tmp_path)
    assert again.kept is None, "nothing was edited"
    edited = tmp_path / "inventory" / "fleet.yaml"
    edited.write_text(edited.read_text(encoding="utf-8") + "# my notes\n", encoding="utf-8")
    third = copy_inventory(EXAMPLE, tmp_path)
    assert third.kept is not None
    assert (third.kept / "fleet.yaml").read_text(encoding="utf-8").endswith("# my notes\n")
    assert "# my notes" not in edited.read_text(encoding="utf-8")


def test_a_fleet_can_start_again_from_its_own_edited_copy(tmp_path: Path) -> None:
    copy = copy_inventory(EXAMPLE, tmp_path)
    edited = copy.inventory / "fleet.yaml"
    edited.write_text(edited.read_text(encoding="utf-8") + "# my notes\n", encoding="utf-8")
    (copy.inventory / "known_hosts").write_text("of nodes that are gone\n", encoding="utf-8")
    again = copy_inventory(copy.inventory, tmp_path)
    assert edited.read_text(encoding="utf-8").endswith("# my notes\n")
    assert not (copy.inventory / "known_hosts").exists()
    assert again.fleet.operators.ssh_keys == copy.fleet.operators.ssh_keys, "the lab's key is there once"


def test_a_lab_directory_inside_its_inventory_is_not_copied(tmp_path: Path) -> None:
    project = tmp_path / "project"
    shutil.copytree(EXAMPLE, project)
    for _ in range(2):
        copy_inventory(project, project / "lab")
    assert not (project / "lab" / "inventory" / "lab").exists()
    assert load_fleet(project / "lab" / "inventory", environ={}).name


def test_the_copy_uses_its_own_known_hosts(tmp_path: Path) -> None:
    project, real = tmp_path / "project", tmp_path / "real_known_hosts"
    shutil.copytree(EXAMPLE, project)
    real.write_text("base ssh-ed25519 AAAA\n", encoding="utf-8")
    fleet = project / "fleet.yaml"
    text = fleet.read_text(encoding="utf-8").replace("operators:\n", f"operators:\n  known_hosts: {real}\n", 1)
    fleet.write_text(text, encoding="utf-8")
    assert load_fleet(project, environ={}).operators.known_hosts == str(real)
    assert copy_inventory(project, tmp_path / "lab").fleet.operators.known_hosts == "known_hosts"


def test_an_inventory_that_cannot_be_copied_leaves_the_earlier_copy(tmp_path: Path) -> None:
    copy = copy_inventory(EXAMPLE, tmp_path / "lab")
    before = contents(copy.inventory)
    project = tmp_path / "project"
    shutil.copytree(EXAMPLE, project)
    (project / "dangling").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="cannot copy"):
        copy_inventory(project, tmp_path / "lab")
    assert contents(copy.inventory) == before
    assert not [path for path in (tmp_path / "lab").iterdir() if path.name.startswith(".inventory.")]


def test_a_failed_rename_keeps_the_previous_inventory_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = copy_inventory(EXAMPLE, tmp_path)
    before = contents(copy.inventory)
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.name == INVENTORY and self.parent.name.startswith(".inventory."):
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    for source in (EXAMPLE, copy.inventory):
        with pytest.raises(InputError, match="Input/output error"):
            fleet_directory.replace_inventory(source, tmp_path)
        assert contents(copy.inventory) == before


def test_clear_reports_and_keeps_unexpected_files(tmp_path: Path) -> None:
    fleet_directory.claim(tmp_path)
    (tmp_path / "log").mkdir()
    (tmp_path / "rom").mkdir()
    with pytest.raises(LabError, match=r"log: expected a file of an earlier fleet"):
        fleet_directory.clear(tmp_path)
    assert (tmp_path / "log").is_dir()
    assert (tmp_path / "rom").is_dir()
    (tmp_path / "log").rmdir()
    fleet_directory.clear(tmp_path)
    assert not (tmp_path / "rom").exists()


def test_clear_removes_a_symlink_without_following_it(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "work.txt").write_text("weeks of work\n", encoding="utf-8")
    fleet_directory.claim(tmp_path / "lab")
    (tmp_path / "lab" / "nodes").symlink_to(elsewhere)
    fleet_directory.clear(tmp_path / "lab")
    assert not (tmp_path / "lab" / "nodes").is_symlink()
    assert (elsewhere / "work.txt").exists()


def test_an_older_lab_directory_without_a_mark_is_recognized(tmp_path: Path) -> None:
    copy_inventory(EXAMPLE, tmp_path)
    (tmp_path / "spec.json").write_text('{"nodes": [], "links": []}', encoding="utf-8")
    (tmp_path / MARK).unlink()
    assert copy_inventory(EXAMPLE, tmp_path).kept is None
    assert (tmp_path / MARK).exists()


def test_an_inventory_copy_is_attributed_to_its_lab(tmp_path: Path) -> None:
    copy = copy_inventory(EXAMPLE, tmp_path / "lab")
    assert lab_of(str(copy.inventory)) == str(tmp_path / "lab")
    assert lab_of(str(copy.inventory / "fleet.yaml")) == str(tmp_path / "lab")
    assert lab_of(str(EXAMPLE)) == ""
    assert lab_of(str(tmp_path / "inventory")) == ""


def test_a_relative_directory_is_the_same_from_everywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    copy = copy_inventory(EXAMPLE, Path("lab"))
    assert copy.inventory == tmp_path / "lab" / "inventory"
    (key_file,) = copy.fleet.nodes["base"].ssh.key_files
    assert key_file == str(tmp_path / "lab" / "keys" / "operator")
