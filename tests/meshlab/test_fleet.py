"""A whole fleet: it starts, stops without leftovers, and reports why it cannot start."""

from __future__ import annotations

import json
import os
import signal
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from meshctl.errors import InputError
from meshlab.cli.commands import app
from meshlab.errors import LabError
from meshlab.fleet import VirtualFleet, VirtualNode
from meshlab.spec import FleetSpec, LinkSpec, Medium, NodeSpec
from tests.meshlab.conftest import KEYS, answers
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]


def spec(count: int) -> FleetSpec:
    names = [f"n{number}" for number in range(count)]
    nodes = tuple(NodeSpec(name, host_key_types=KEYS, medium=Medium.BENCH) for name in names)
    return FleetSpec("short", nodes, tuple(LinkSpec(names[0], name) for name in names[1:]))


def processes_of(directory: Path) -> list[int]:
    """Processes that work in the fleet's directory: the supervisor, the node runner, and everything on the nodes."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            root = os.readlink(entry / "root")
            words = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if str(directory) in words.decode("utf-8", "replace") or str(directory) in root:
            found.append(int(entry.name))
    return found


def mounts_of(directory: Path) -> list[str]:
    return [line for line in Path("/proc/self/mountinfo").read_text().splitlines() if str(directory) in line]


def ended(pids: list[int]) -> bool:
    return all(not Path(f"/proc/{pid}").exists() or _is_zombie(pid) for pid in pids)


def _is_zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def test_ten_nodes_come_up_and_go_down_without_a_trace(tmp_path: Path) -> None:
    fleet = VirtualFleet(spec(10), tmp_path)
    with fleet:
        status = fleet.status()
        assert [node["power"] for node in status["nodes"]] == ["up"] * 10
        assert all(answers(node.bench) for node in fleet.nodes[:3])
        pids = [status["pid"], *(node["pid"] for node in status["nodes"]), *processes_of(tmp_path)]
        assert mounts_of(tmp_path) == []
    until(lambda: ended(pids), "every process to end")
    assert processes_of(tmp_path) == []
    with pytest.raises(LabError, match="no virtual fleet runs"):
        fleet.status()


def test_a_killed_supervisor_takes_its_nodes_with_it(tmp_path: Path) -> None:
    fleet = VirtualFleet(spec(2), tmp_path).up()
    status = fleet.status()
    pids = [node["pid"] for node in status["nodes"]]
    os.kill(status["pid"], signal.SIGKILL)
    until(lambda: ended([status["pid"], *pids]), "every process to end")
    # and the directory can be used again
    with fleet:
        assert fleet.node("n0").is_up()


def test_a_second_fleet_is_rejected_in_the_same_directory_but_not_in_another(
    fleet: VirtualFleet, tmp_path: Path
) -> None:
    with pytest.raises(LabError, match=r"runs in .* already"):
        VirtualFleet(fleet.spec, fleet.directory).up()
    with VirtualFleet(spec(1), tmp_path) as beside:
        assert beside.port != fleet.port
        assert answers(beside.node("n0").bench)
        assert answers(fleet.node("box").bench)


def test_a_port_in_use_is_reported(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.255.255.254", 0))
        taken.listen(1)
        port = taken.getsockname()[1]
        with pytest.raises(LabError, match=f"port {port}"):
            VirtualFleet(FleetSpec("x", spec(1).nodes, port=port), tmp_path).up()


def test_unknown_nodes_faults_and_link_options_are_reported(fleet: VirtualFleet) -> None:
    with pytest.raises(InputError, match="no node named nobody"):
        fleet.inject_fault("nobody", "power-cut")
    with pytest.raises(InputError, match="unknown fault"):
        fleet.inject_fault("near", "explode")
    with pytest.raises(InputError, match="is for nodes"):
        fleet.inject_fault("base-near", "full-flash")
    with pytest.raises(InputError, match="colour"):
        fleet.link("base", "near", colour="red")


def test_the_command_line_drives_a_fleet(tmp_path: Path) -> None:
    runner = CliRunner()
    place = ["--dir", str(tmp_path / "lab")]

    def lab(*words: str) -> str:
        done = runner.invoke(app, [*words], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return done.output

    try:
        said = lab("up", "--nodes", "2", *place)
        assert "2 nodes of lab are up" in said
        inventory = tmp_path / "lab" / "inventory"
        assert "lab-operator" in (inventory / "fleet.yaml").read_text()
        state = json.loads(lab("status", "--json", *place))
        assert [node["name"] for node in state["nodes"]] == ["base", "rover1"]
        lab("link", "base", "rover1", "--delay", "5", "--down", *place)
        lab("break", "rover1", "off", *place)
        assert "off" in lab("status", *place)
        lab("mend", *place)
        VirtualFleet.attach(tmp_path / "lab").node("rover1").wait_up()
        lab("unplug", *place)
        plugged = {node["name"]: node["plugged"] for node in json.loads(lab("status", "--json", *place))["nodes"]}
        assert plugged == {"base": True, "rover1": False}
        # the operator's own cable
        assert "`meshctl lab plug base`" in lab("unplug", "base", *place)
    finally:
        runner.invoke(app, ["down", *place])
    image = tmp_path / "image.bin"
    lab("image", "24.10", "compex,wpj344-16m", str(image))
    assert image.stat().st_size > 256 * 1024


def test_nodes_have_small_tables_of_connections_after_connections_too(fleet: VirtualFleet, node: VirtualNode) -> None:
    """Each dropbear reads all of /proc/net/tcp. The kernel of a network with the machine's table says so by a minus."""
    size = Path("/proc/sys/net/ipv4/tcp_ehash_entries")
    for _ in range(2):
        with socket.create_connection((node.bench.host, node.bench.port), timeout=60) as connection:
            assert connection.recv(4) == b"SSH-"
        # kernels before 6.1 have one table for all networks
        assert not size.exists() or int(node.exec(f"cat {size}").stdout) == 1024
        node.reboot()
