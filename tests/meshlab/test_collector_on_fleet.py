"""The collector end to end: a virtual radio with dropbear, the system's ssh, a real daemon, a client."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from meshctl.device.authentication import new_key_pair
from meshctl.inventory import load_fleet
from meshctl.model import Secret
from meshctl.render import LINKS_PATH, render_node
from meshctl.robots.radio_session import OwnRadio, RadioLogin, ssh_command
from meshlab.fleet import VirtualFleet, VirtualNode
from tests.meshlab.conftest import LINE, MESH
from tests.meshlab.test_ground_on_fleet import mac_of
from tests.udp_mesh.daemon.processes import RunningDaemon, two_daemons
from tests.waiting import until
from udp_mesh.client.turn_back import Need, decide

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]

# of the two robots with daemons, alice has the radio near, and bob far
INVENTORY = """\
meshctl: 1
fleet: collectors
country: US
operators: {{ssh_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8g test"]}}
hardware:
  rocket:
    board: ubnt,rocket-m
    profile: ubnt_rocket-m
    target: ath79/generic
    release: "23.05"
    lan_ports: [eth0]
    radios: {{radio0: {{path: "pci0000:00/0000:00:00.0", band: 2g, rated_power_dbm: 30, max_drive_dbm: 28}}}}
meshes:
  main: {{ssid: fleet, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, network: 10.42.0.0/24}}
defaults: {{hardware: rocket, state: deployed}}
nodes:
  base: {{role: base, address: 10.42.0.1}}
  near: {{address: 10.42.0.2}}
  far: {{address: 10.42.0.3}}
robots:
  alice: {{nodes: [{radios}], computer: {{address: 10.42.0.12/24, collector: true, collector_key: "{key}"}}}}
"""
AUTHORIZED_KEYS = "etc/dropbear/authorized_keys"
# without a password a factory-fresh node lets everyone in
DROPBEAR = "etc/config/dropbear"


@dataclass(frozen=True)
class Team:
    """Alice's radio accepts the collector's key; her daemon and bob's run."""

    fleet: VirtualFleet
    alice: RunningDaemon
    radios: tuple[OwnRadio, ...]
    login: RadioLogin
    file: Path

    @property
    def near(self) -> VirtualNode:
        return self.fleet.node("near")

    @property
    def radio(self) -> OwnRadio:
        (found,) = self.radios
        return found

    @contextmanager
    def collector(self) -> Iterator[subprocess.Popen[str]]:
        command = [sys.executable, "-m", "meshctl.robots.collector", str(self.file), "--socket", str(self.alice.socket)]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            yield process
        finally:
            process.terminate()
            process.communicate(timeout=30)

    def conditions(self) -> dict[str, Any]:
        with self.alice.client() as client:
            found: dict[str, Any] = client.request("status")["conditions"]
        return found

    def path(self) -> dict[str, Any] | None:
        """The radio path to bob."""
        return next((peer["radio"] for peer in self.conditions()["peers"]), None)

    def signal_dbm(self) -> float | None:
        path = self.path()
        return None if path is None else path["signal_dbm"]

    def problem(self) -> str:
        radio = self.conditions()["radio"]
        return "" if radio is None else radio["problem"] or ""


@contextmanager
def team_with(
    mesh: VirtualFleet, folder: Path, radios: Sequence[str], robots: Mapping[str, Sequence[str]]
) -> Iterator[Team]:
    """Alice with these radios; `robots` are the radios of the others."""
    private, public = new_key_pair("collector of alice")
    (folder / "fleet.yaml").write_text(INVENTORY.format(radios=", ".join(radios), key=public))
    fleet = load_fleet(folder / "fleet.yaml")
    before, known_hosts, own = {}, "", []
    for name in radios:
        node = mesh.node(name)
        rendered = {file.path: file for file in render_node(fleet, name, lambda _: Secret("")).files}
        before[name] = node.exec(f"cat /{DROPBEAR}").stdout_bytes
        for path in (AUTHORIZED_KEYS, LINKS_PATH, DROPBEAR):
            write(node, path, rendered[path].content, rendered[path].mode)
        node.exec("reload_config").check("reload dropbear")
        shown = node.exec("dropbearkey -y -f /etc/dropbear/dropbear_ed25519_host_key").stdout
        (host_key,) = (line for line in shown.splitlines() if line.startswith("ssh-ed25519 "))
        known_hosts += f"{name} {host_key}\n"
        endpoint = mesh.endpoint(f"10.42.0.{LINE.index(name) + 1}")
        own.append(OwnRadio(name, endpoint.host, endpoint.port))
    key = folder / "id_ed25519"
    key.write_bytes(private)
    key.chmod(0o600)
    (folder / "known_hosts").write_text(known_hosts)
    document = {
        "version": 1,
        "robot": "alice",
        "radios": [{"name": one.name, "host": one.host, "port": one.port, "user": "root"} for one in own],
        "robots": robots,
        "key": key.name,
        "known_hosts": "known_hosts",
        "names": "names.json",
        "macs": {},
        "load_mbit_s": 2.0,
        "interval_s": 0.3,
    }
    (folder / "collector.json").write_text(json.dumps(document))
    (folder / "names.json").write_text(json.dumps({mac_of(mesh, name): name for name in LINE}))
    try:
        with two_daemons() as (alice, _):
            yield Team(mesh, alice, tuple(own), RadioLogin(key, folder / "known_hosts"), folder / "collector.json")
    finally:
        for name in radios:
            node = mesh.node(name)
            node.wait_up()
            write(node, DROPBEAR, before[name], 0o644)
            node.exec(f"rm -f /{AUTHORIZED_KEYS} /{LINKS_PATH}; sync; reload_config").check("remove the key")


@pytest.fixture
def team(mesh: VirtualFleet, tmp_path: Path) -> Iterator[Team]:
    with team_with(mesh, tmp_path, ["near"], {"base": ["base"], "bob": ["far"]}) as found:
        yield found
    mesh.link("near", "far", signal_dbm=-58)


def write(node: VirtualNode, path: str, content: bytes, mode: int) -> None:
    words = f"mkdir -p /{Path(path).parent} && cat >/{path} && chmod {mode:o} /{path} && sync"
    node.exec(words, stdin=content).check(f"write {path}")


def test_conditions_have_the_radio_path_of_each_peer(team: Team) -> None:
    assert team.path() is None
    with team.collector():
        until(lambda: team.path() is not None, "the radio path to bob")
        path = team.path()
        assert path is not None
        assert (path["source"], path["radio"], path["next_hop"], path["signal_dbm"]) == ("near", "near", "far", -58)
        assert path["quality"] == pytest.approx(200 / 255, abs=0.05)
        assert 0.0 <= path["age_s"] < 10.0
        assert path["margin_db"] > 10.0
        neighbors = {one["name"]: one["signal_dbm"] for one in team.conditions()["radio"]["neighbors"]}
        assert neighbors == {"base": -61, "far": -58}
        # bob drives away
        team.fleet.link("near", "far", signal_dbm=-84)
        until(lambda: team.signal_dbm() == -84, "the weaker signal")
        until(lambda: margin_db(team) < 0.0, "no margin")
        (bob,) = team.conditions()["peers"]
        assert decide(bob, Need(1.0, 9, margin_db=3.0), before=False).turn_back
        assert not decide(bob, Need(1.0, 9), before=False).turn_back
        # a daemon that restarts knows nothing, and gets the next report
        team.alice.stop()
        team.alice.start()
        until(lambda: team.path() is not None, "the radio path after a restart")
    until(lambda: team.conditions()["radio"] is None, "the collector's silence")
    assert team.path() is None


def margin_db(team: Team) -> float:
    path = team.path()
    assert path is not None
    return float(path["margin_db"])


def test_a_radio_that_is_off_is_named_and_asked_again(team: Team) -> None:
    with team.collector():
        until(lambda: team.path() is not None, "the radio path to bob")
        team.near.power_cut(back=False)
        until(lambda: "near does not answer: " in team.problem(), "the silent radio")
        until(lambda: team.path() is None, "the end of its values")
        # the collector lives
        assert team.conditions()["radio"]["source"] == "near"
        team.near.power_on()
        until(lambda: team.path() is not None, "the radio path after a boot", wait_s=90.0)
        assert team.problem() == ""


def test_the_key_of_a_collector_runs_nothing_else(team: Team) -> None:
    command = [*ssh_command(team.radio, team.login)[:-1], "touch /tmp/run-by-a-collector"]
    done = subprocess.run(
        command, input=b"meshctl-1\n$(touch /tmp/run-by-a-collector)\n", capture_output=True, check=False
    )
    assert done.stdout.startswith(b"meshctl-1 begin iw.stations mesh0\n")
    assert team.near.exec("ls /tmp/run-by-a-collector").exit_status != 0
    # neither a terminal nor a tunnel
    tunnel = [*ssh_command(team.radio, team.login)[:-2], "-W", "127.0.0.1:22", team.radio.host]
    refused = subprocess.run(tunnel, input=b"", capture_output=True, check=False, timeout=60)
    assert refused.returncode != 0
    assert b"SSH-2.0" not in refused.stdout


def test_a_changed_host_key_is_refused_and_named(team: Team) -> None:
    _, other = new_key_pair("another radio")
    team.login.known_hosts.write_text(f"near {other}\n")
    with team.collector():
        until(lambda: "near does not answer: " in team.problem(), "the refusal")
        assert "Host key verification failed" in team.problem()


def test_the_better_of_two_radios_counts_until_it_is_off(mesh: VirtualFleet, tmp_path: Path) -> None:
    """A robot with one radio in front and one behind, and bob at the base."""
    mesh.link("far", "base", tq=150, signal_dbm=-75)
    with team_with(mesh, tmp_path, ["near", "far"], {"bob": ["base"]}) as team, team.collector():
        until(lambda: radio_and_signal(team) == ("near", -61), "the path of the better radio")
        # they answer one after the other
        until(lambda: {("near", "base"), ("far", "base")} <= heard_by_radios(team), "both radios' neighbors")
        assert team.conditions()["radio"]["source"] == "near and far"
        # the robot turns round
        mesh.link("far", "base", tq=250, signal_dbm=-55)
        mesh.link("near", "base", tq=100, signal_dbm=-80)
        until(lambda: radio_and_signal(team) == ("far", -55), "the path of the other radio")
        mesh.link("near", "base", tq=240, signal_dbm=-61)
        mesh.link("far", "base", tq=150, signal_dbm=-75)
        until(lambda: radio_and_signal(team) == ("near", -61), "the path of the first radio again")
        team.near.power_cut(back=False)
        until(lambda: radio_and_signal(team) == ("far", -75), "the path of the radio that is left", wait_s=60.0)
        assert team.problem().startswith("near does not answer: ")
        team.near.power_on()
        until(lambda: radio_and_signal(team) == ("near", -61), "the path after a boot", wait_s=90.0)
        until(lambda: team.problem() == "", "no problem any more")


def heard_by_radios(team: Team) -> set[tuple[str, str]]:
    return {(one["radio"], one["name"]) for one in team.conditions()["radio"]["neighbors"]}


def radio_and_signal(team: Team) -> tuple[str, int] | None:
    path = team.path()
    return None if path is None else (path["radio"], path["signal_dbm"])


WITHOUT_ROUTING_TABLE = """
uci -q batch <<END
delete network.bat0
delete network.mesh0.master
set network.mesh0.proto=none
commit
END
reload_config
"""


def test_a_radio_without_a_routing_table_has_the_paths_of_the_robots_that_it_hears(
    mesh: VirtualFleet, tmp_path: Path
) -> None:
    """As with meshmerize: its virtual radio meshes, and has nothing that the collector could read besides stations."""
    with team_with(mesh, tmp_path, ["near"], {"bob": ["far"], "carol": ["of no radio in reach"]}) as team:
        team.near.plug(True)
        team.near.exec(WITHOUT_ROUTING_TABLE).check("remove batman-adv")
        with team.collector():
            found: list[dict[str, Any]] = []

            def is_without_quality() -> bool:
                found[:] = [path for path in [team.path()] if path is not None and path["quality"] is None]
                return bool(found)

            until(is_without_quality, "the path to bob without a routing table")
            (path,) = found
            assert (path["radio"], path["next_hop"], path["signal_dbm"]) == ("near", "far", -58)
            # what the driver expects of the hop is all that is known
            assert path["bottleneck_bits_per_s"] > 1e6
            assert path["margin_db"] > 10.0
            mesh.link("near", "far", up=False)
            until(lambda: team.path() is None, "the end of the path")
            assert {one["name"] for one in team.conditions()["radio"]["neighbors"]} == {"base"}
        team.near.exec(MESH.format(address="10.42.0.2", channel=6) + "sync").check("restore batman-adv")
