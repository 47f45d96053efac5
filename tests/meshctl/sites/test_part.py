"""A site's part of the inventory: all that its nodes need, as they had it, and nothing of other sites."""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path

import pytest

from meshctl.device.trust import TrustStore
from meshctl.inventory import load_fleet
from meshctl.inventory.include import read_files
from meshctl.inventory.secrets import SecretStore
from meshctl.model import Fleet, Secret, SecretRef
from meshctl.nodes.desired import Renderer
from meshctl.resources import shipped
from meshctl.sites.bundle import PartDiffers, SiteBundle, site_bundle
from meshctl.sites.part import differences, site_part

_WORKER = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8g worker"
_OPERATOR = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f alice"
_TWO_SITES = f"""\
meshctl: 1
fleet: two
country: NO
include: [topics.yaml]
operators: {{ssh_keys: ["{_OPERATOR}"]}}
system: {{timezone: "EST5EDT,M3.2.0,M11.1.0", log_host: 10.0.0.9}}
hardware:
  box:
    board: compex,wpj344-16m
    profile: compex_wpj344-16m
    target: ath79/generic
    release: 24.10
    lan_ports: [eth0]
    packages: [tcpdump]
    package_files: [own/tool.ipk]
    firmware: {{image: images/box.bin, sha256: "{"0" * 64}", revision: r1}}
    radios: {{radio0: {{path: platform/ahb/18100000.wmac, band: 2g, rated_power_dbm: 30, max_drive_dbm: 27}}}}
  other:
    board: ubnt,rocket-m
    profile: ubnt_rocket-m
    target: ath79/generic
    release: "23.05"
    lan_ports: [eth0]
    firmware: {{image: images/absent.bin, sha256: "{"1" * 64}", revision: r1}}
    radios: {{radio0: {{path: "pci0000:00/0000:00:00.0", band: 2g, rated_power_dbm: 30, max_drive_dbm: 28}}}}
meshes:
  up:
    ssid: "a: b"
    bssid: 12:34:56:12:34:56
    band: 2g
    channel: 6
    network: 10.1.0.0/24
    encryption: psk2+ccmp
    key: {{file: keys.yaml, key: up}}
  down:
    ssid: "no"
    band: 2g
    channel: 11
    network: 10.2.0.0/24
    mode: mesh
    encryption: sae
    key: {{file: keys.yaml, key: down}}
sites:
  north: {{ssh: {{host: north.example.org}}, worker_key: {_WORKER}}}
  south: {{ssh: {{host: south.example.org}}}}
defaults: {{hardware: box, state: deployed, ssh: {{key_files: [~/.ssh/mine]}}, address: {{rule: network + 10 + index}}}}
groups:
  up: {{site: north, radios: {{radio0: {{mesh: up}}}}}}
  down: {{site: south, hardware: other, radios: {{radio0: {{mesh: down}}}}}}
nodes:
  s[1-3]: {{groups: [down]}}
  n[01-20]: {{groups: [up]}}
  n05: {{label: "0x10", radios: {{radio0: {{tx_power_dbm: 7}}}}, extra_uci: {{wireless.radio0.rts: "500"}}}}
  n-base: {{groups: [up], role: base, address: 10.1.0.1}}
robots:
  rover:
    nodes: [n01]
    carries: ["n[02-04]", s1]
    relay: [all]
    computer: {{address: 10.1.0.201/24, ssh: {{user: robot}}}}
  buggy: {{nodes: [s2], computer: {{address: 10.2.0.201/24, ssh: {{user: robot}}}}}}
udp_mesh: {{keys: [{{file: keys.yaml, key: transport}}]}}
"""
_KEYS = {"up": "the key of the upper mesh", "down": "the key of the lower mesh", "transport": "ab" * 32}


@pytest.fixture
def inventory(tmp_path: Path) -> Path:
    folder = tmp_path / "inventory"
    for name, content in (
        ("fleet.yaml", _TWO_SITES),
        ("topics.yaml", "topics: {estop: {priority: 0, destinations: [rover, buggy]}}\n"),
        ("keys.yaml", json.dumps(_KEYS)),
        ("images/box.bin", "an image"),
        ("own/tool.ipk", "a package"),
        ("templates/common/etc/motd.j2", "welcome\n"),
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    return folder


def _secrets(folder: Path) -> SecretStore:
    return SecretStore({}, folder)


def _bundle(folder: Path, site: str, *, with_firmware: bool = True) -> SiteBundle:
    fleet = load_fleet(folder)
    trust = TrustStore(folder / "known_hosts")
    return site_bundle(folder, fleet, site, _secrets(folder).get, trust, {}, with_firmware=with_firmware)


def _unpack(bundle: SiteBundle, folder: Path) -> Path:
    with tarfile.open(fileobj=io.BytesIO(bundle.archive)) as tar:
        for member in tar:
            file = tar.extractfile(member)
            assert file is not None
            (folder / member.name).parent.mkdir(parents=True, exist_ok=True)
            (folder / member.name).write_bytes(file.read())
    return folder


def _files(fleet: Fleet, folder: Path, name: str) -> tuple[object, ...]:
    return tuple(Renderer.of(fleet, _secrets(folder).get).desired(fleet.nodes[name]).files)


@pytest.mark.parametrize("site", ["north", "south"])
def test_the_worker_renders_the_same_files_as_the_operator(inventory: Path, tmp_path: Path, site: str) -> None:
    here = load_fleet(inventory)
    folder = _unpack(_bundle(inventory, site, with_firmware=site == "north"), tmp_path / "part")
    there = load_fleet(folder)
    names = [name for name, node in here.nodes.items() if node.site == site]
    assert len(names) == (21 if site == "north" else 3)
    for name in names:
        assert _files(there, folder, name) == _files(here, inventory, name)


def test_the_worker_key_is_one_of_the_operators(inventory: Path, tmp_path: Path) -> None:
    folder = _unpack(_bundle(inventory, "north"), tmp_path / "part")
    assert load_fleet(folder).operators.ssh_keys == (_OPERATOR, _WORKER)


def test_a_part_has_nothing_of_other_sites(inventory: Path, tmp_path: Path) -> None:
    folder = _unpack(_bundle(inventory, "north"), tmp_path / "part")
    fleet = load_fleet(folder)
    assert {node.site for node in fleet.nodes.values()} == {"north"}
    assert set(fleet.robots) == {"rover"}
    assert not fleet.topics
    everything = "".join(path.read_text() for path in folder.rglob("*") if path.is_file())
    assert _KEYS["up"] in everything
    for absent in (_KEYS["down"], _KEYS["transport"], "south.example.org", "buggy", ".ssh/mine"):
        assert absent not in everything, absent


def test_files_of_the_part_are_named_by_their_paths_in_it(inventory: Path, tmp_path: Path) -> None:
    bundle = _bundle(inventory, "north")
    ((path, digest),) = bundle.images.items()
    assert bundle.image_files[digest] == inventory / "images/box.bin"
    folder = _unpack(bundle, tmp_path / "part")
    fleet = load_fleet(folder)
    assert fleet.hardware["box"].firmware.image == path
    assert [(folder / file).read_text() for file in fleet.hardware["box"].package_files] == ["a package"]
    assert (folder / "templates/common/etc/motd.j2").is_file()


def test_no_firmware_sends_no_image(inventory: Path) -> None:
    assert not _bundle(inventory, "north", with_firmware=False).images


def test_a_missing_file_is_named(inventory: Path) -> None:
    (inventory / "own/tool.ipk").unlink()
    with pytest.raises(Exception, match=r"own/tool\.ipk: cannot be read: No such file"):
        _bundle(inventory, "north")


def test_a_part_that_would_be_read_otherwise_is_not_sent(inventory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshctl.sites.bundle.differences", lambda *_: iter(["n01: address"]))
    with pytest.raises(PartDiffers, match="n01: address"):
        _bundle(inventory, "north")


def test_differences_are_found(inventory: Path) -> None:
    here = load_fleet(inventory)
    text = (inventory / "fleet.yaml").read_text()
    (inventory / "fleet.yaml").write_text(
        text.replace("tx_power_dbm: 7", "tx_power_dbm: 8").replace("10.0.0.9", "10.0.0.8")
    )
    assert list(differences(here, load_fleet(inventory), "north")) == ["n05: radios", "system"]


@pytest.mark.parametrize("example", sorted(path.parent.name for path in shipped("inventory").glob("*/fleet.yaml")))
def test_every_shipped_example_may_be_one_site(example: str, tmp_path: Path) -> None:
    source = shipped("inventory") / example
    for file in source.iterdir():
        if file.is_file():
            (tmp_path / file.name).write_bytes(file.read_bytes())
    first = tmp_path / "fleet.yaml"
    text = first.read_text()
    site = f"sites: {{all: {{ssh: {{host: gateway}}, worker_key: {_WORKER}}}}}\n"
    if "\ndefaults:" in text:
        text = text.replace("\ndefaults:\n", "\ndefaults:\n  site: all\n").replace(
            "\ndefaults: {", "\ndefaults: {site: all, "
        )
    else:
        text += "defaults: {site: all}\n"
    first.write_text(text + site)
    fleet = load_fleet(tmp_path)
    root = read_files(tmp_path, {}).root
    assert root is not None

    def secret(_ref: SecretRef) -> Secret:
        return Secret("a # secret: 'with' \"everything\"")

    part = site_part(root, fleet, "all", secret, with_firmware=True)
    (tmp_path / "part").mkdir()
    (tmp_path / "part/fleet.yaml").write_text(part.inventory)
    assert list(differences(fleet, load_fleet(tmp_path / "part"), "all")) == []
    assert all(node.site == "all" for node in fleet.nodes.values())
