"""What a robot's computer gets for its collector, and that it runs with nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
import tarfile
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from zipfile import ZipFile

import pytest

from meshctl.device.trust import parse_key
from meshctl.inventory import load_fleet
from meshctl.model import Fleet, Secret, SecretRef
from meshctl.robots.bundle import OPTIONAL_UNITS, bundle, configuration
from meshctl.robots.collector import load
from meshctl.robots.collector_release import (
    COLLECTOR_UNIT_NAME,
    CONFIG_NAME,
    RadioKnowledge,
    collector_config,
    collector_wheel,
    missing_pins,
    radio_archive,
)
from meshctl.robots.expected_release import expected_release
from meshctl.robots.preconditions import HostFacts, parse_facts, unmet_for_collector
from meshctl.robots.wheels import own_wheel, stock_units

ROOT = Path(__file__).resolve().parents[3]
HOST_KEY = parse_key("ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8g")


def _secrets(_: SecretRef) -> Secret:
    return Secret("00112233445566778899aabbccddeeff" * 2)


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    """The example fleet, with a collector on husky1."""
    whole = load_fleet(ROOT / "inventory/subt-final")
    husky = whole.robots["husky1"]
    assert husky.computer is not None
    with_it = replace(husky, computer=replace(husky.computer, collector=True))
    return replace(whole, robots={**whole.robots, "husky1": with_it})


def test_the_configuration_is_what_the_collector_reads_and_nothing_else(fleet: Fleet, tmp_path: Path) -> None:
    path = tmp_path / CONFIG_NAME
    path.write_bytes(collector_config(fleet, "husky1"))
    found = load(path)
    assert [(radio.name, radio.host, radio.port, radio.user) for radio in found.radios] == [
        ("husky1-front", str(fleet.nodes["husky1-front"].address.ip), 22, "root"),
        ("husky1-rear", str(fleet.nodes["husky1-rear"].address.ip), 22, "root"),
    ]
    assert found.robots["base-station"] == ("base",)
    assert "husky1" not in found.robots
    assert str(found.login.key) == "/var/lib/udp-mesh/collector/id_ed25519"
    # no address, key or name of a radio that it does not ask, but for the names of the robots' own
    text = path.read_text()
    assert str(fleet.nodes["husky2-front"].address.ip) not in text
    assert "husky1-b01" not in text


def test_a_router_is_asked_at_its_address_on_the_robots_switch() -> None:
    routed = load_fleet(ROOT / "inventory/routed")
    (name, robot), *_ = ((name, robot) for name, robot in routed.robots.items() if robot.lan is not None)
    radio = json.loads(collector_config(routed, name))["radios"][0]
    lan_address = routed.nodes[robot.nodes[0]].lan_address
    assert lan_address is not None
    assert radio["host"] == str(lan_address.ip)


def test_only_robots_with_a_collector_get_its_files_and_wheel(fleet: Fleet) -> None:
    units = stock_units()
    made = {
        robot: bundle(fleet, robot, _secrets, [own_wheel()], executable="/usr/bin/python3", units=units)
        for robot in ("husky1", "husky2")
    }
    new = {file.path for file in made["husky1"].files} - {file.path for file in made["husky2"].files}
    assert new == {"bin/udp-mesh-collector", "etc/collector.json", COLLECTOR_UNIT_NAME}
    assert [wheel.file.partition("-")[0] for wheel in made["husky1"].wheels] == ["udp_mesh", "meshctl_collector"]
    assert [wheel.file.partition("-")[0] for wheel in made["husky2"].wheels] == ["udp_mesh"]
    unit = made["husky1"].file(COLLECTOR_UNIT_NAME)
    assert unit is not None
    assert b"ExecStart=/opt/udp-mesh/current/bin/udp-mesh-collector\n" in unit.content
    # no private key is in a release
    assert not any(b"PRIVATE KEY" in file.content for file in configuration(fleet, "husky1", _secrets, units))
    expected = expected_release(fleet, "husky1", _secrets)
    assert expected.units == ("udp-mesh.service", "udp-mesh-ros1.service", COLLECTOR_UNIT_NAME)
    assert set(expected.wheels) == {"udp-mesh", "the collector"}
    assert set(expected.units[1:]) < set(OPTIONAL_UNITS)


def test_the_wheel_runs_without_any_other_package(fleet: Fleet, tmp_path: Path) -> None:
    with ZipFile(BytesIO(collector_wheel().content)) as archive:
        archive.extractall(tmp_path / "lib")
    (tmp_path / "collector.json").write_bytes(collector_config(fleet, "husky1"))
    # -S: without site-packages; -I: without the working directory and variables of the user
    script = """
import sys
sys.path.insert(0, sys.argv[1])
from meshctl.robots import collector
from meshctl.device.link_table import answering_script
found = collector.load(collector.Path(sys.argv[2]))
assert "while read -r N" in answering_script()
assert len(collector.collector(found, None, print).pollers) == 2
outside = sorted({name.split(".")[0] for name in sys.modules} - sys.stdlib_module_names - {"__main__"})
print(outside)
"""
    words = [sys.executable, "-I", "-S", "-c", script, str(tmp_path / "lib"), str(tmp_path / "collector.json")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.stdout == "['meshctl']\n", done.stderr


def test_the_archive_has_the_pins_of_its_own_radios_and_the_names_of_all(fleet: Fleet) -> None:
    pins = {"husky1-front": (HOST_KEY,), "husky2-front": (HOST_KEY,)}
    known = RadioKnowledge(
        lambda node: pins.get(node, ()), lambda: {"06:00:00:00:00:01": "b", "02:00:00:00:00:01": "a"}
    )
    with tarfile.open(fileobj=BytesIO(radio_archive(fleet, "husky1", known))) as tar:
        files = {name: (tar.extractfile(name) or BytesIO()).read().decode() for name in tar.getnames()}
    assert files["known_hosts"] == f"husky1-front {HOST_KEY.text}\n"
    assert list(json.loads(files["names.json"])) == ["02:00:00:00:00:01", "06:00:00:00:00:01"]
    assert missing_pins(fleet, "husky1", known) == ("husky1-rear",)
    assert missing_pins(fleet, "husky1", RadioKnowledge()) == ("husky1-front", "husky1-rear")


def test_what_a_collector_needs_is_refused_before_anything_changes() -> None:
    assert parse_facts("no_ssh=yes\n").has_ssh is False
    facts = HostFacts(has_ssh=False)
    reasons = list(unmet_for_collector(facts, robot="husky1", radios=[], without_pin=["a", "b"]))
    assert [reason for reason, _ in reasons] == [
        "its collector has no radio to ask",
        "its collector needs ssh and ssh-keygen",
        "no host key is pinned of its radios a, b",
    ]
    assert reasons[2][1] == "run `meshctl trust a b`"
    assert not list(unmet_for_collector(parse_facts(""), robot="husky1", radios=["a"], without_pin=[]))
