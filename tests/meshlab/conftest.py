"""A small fleet shared by the tests of this folder, and helpers to access its nodes."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import paramiko
import pytest

from meshctl.device.connection import Endpoint
from meshctl.model import Release
from meshlab.fleet import VirtualFleet, VirtualNode
from meshlab.spec import FleetSpec, LinkSpec, Medium, NodeSpec
from tests.waiting import until

# one kind of host key: generating RSA keys would take most of the tests' time
KEYS = ("ed25519",)
LINE = ("base", "near", "far")
MESH = """
uci -q batch <<END
set network.lan.ipaddr={address}
set network.bat0=interface
set network.bat0.proto=batadv
set network.mesh0=interface
set network.mesh0.proto=batadv_hardif
set network.mesh0.master=bat0
set network.mesh0.mtu=1536
delete network.@device[0].ports
add_list network.@device[0].ports=eth0
add_list network.@device[0].ports=bat0
set wireless.radio0.disabled=0
set wireless.radio0.channel={channel}
delete wireless.default_radio0
set wireless.mesh0=wifi-iface
set wireless.mesh0.device=radio0
set wireless.mesh0.network=mesh0
set wireless.mesh0.mode=adhoc
set wireless.mesh0.ifname=mesh0
set wireless.mesh0.ssid='a team'
set wireless.mesh0.bssid=02:ca:fe:00:00:01
set wireless.mesh0.encryption=none
commit
END
reload_config
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Each worker that runs a test of the shared fleet starts one: the tests of a group have one worker."""
    for item in items:
        is_shared = "fleet" in getattr(item, "fixturenames", ()) and item.path.is_relative_to(Path(__file__).parent)
        if is_shared and item.get_closest_marker("xdist_group") is None:
            raise pytest.UsageError(f"{item.nodeid} uses the shared fleet: mark it with pytest.mark.xdist_group")


def factory_reset(node: VirtualNode) -> None:
    """Erase what the node has on flash, and boot it. The fleet is shared: a radio that a test leaves behind would be
    taken for the next one's."""
    node.exec("cd /lab/node/flash && rm -rf current copy.* sysupgrade.tgz").check("erase flash")
    node.power_cut()


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VirtualFleet]:
    """base - near - far in a line, a working mesh in which only the base is wired; factory-fresh on the bench: `box`,
    `old` (19.07) and `new` (25.12, with little flash)."""
    nodes = (
        NodeSpec("base", medium=Medium.BASE, host_key_types=KEYS),
        NodeSpec("near", host_key_types=KEYS),
        NodeSpec("far", host_key_types=KEYS),
        NodeSpec("box", host_key_types=KEYS),
        NodeSpec("old", release=Release.V19_07),
        NodeSpec("new", release=Release.V25_12, host_key_types=KEYS, overlay_kib=1024),
    )
    links = (LinkSpec("base", "near", tq=240, signal_dbm=-61), LinkSpec("near", "far", tq=200))
    with VirtualFleet(FleetSpec("tests", nodes, links), tmp_path_factory.mktemp("fleet")) as running:
        for number, name in enumerate(LINE, 1):
            running.node(name).exec(MESH.format(address=f"10.42.0.{number}", channel=6) + "sync").check(
                f"set up {name}"
            )
        unplug(running)
        yield running


@pytest.fixture
def mesh(fleet: VirtualFleet) -> Iterator[VirtualFleet]:
    """The line of three; changes of a test are undone afterwards, with a power cut where it changed a node."""
    until(lambda: in_mesh(fleet) == {"near", "far"}, "the mesh of three")
    yield fleet
    fleet.repair()
    for name in LINE:
        restore(fleet.node(name))
    unplug(fleet)


@pytest.fixture
def node(fleet: VirtualFleet) -> Iterator[VirtualNode]:
    """A factory-fresh node, which is reset afterwards."""
    box = fleet.node("box")
    box.wait_up()
    yield box
    fleet.repair("box")
    box.wait_up()
    factory_reset(box)


def unplug(fleet: VirtualFleet) -> None:
    for name in LINE[1:]:
        fleet.node(name).plug(False)


def restore(node: VirtualNode) -> None:
    """Restore the flash content, if the node's files differ from it."""
    node.wait_up()
    same = """
    cd /lab/node/flash/current
    for file in $(find etc usr/lib -type f) $(cd / && find etc usr/lib -type f); do
        cmp -s "/$file" "$file" || exit 1
    done
    [ -z "$(uci changes)" ] && ! [ -e /tmp/lab/steps.log ]
    """
    if node.exec(same).exit_status != 0:
        node.power_cut()


def in_mesh(fleet: VirtualFleet) -> set[str]:
    return {node["name"] for node in fleet.status()["nodes"] if node["in_mesh"]}


def connect(endpoint: Endpoint) -> paramiko.Transport:
    """Log in as root without a password, as first contact does."""
    transport = paramiko.Transport(socket.create_connection((endpoint.host, endpoint.port), timeout=60))
    try:
        transport.start_client(timeout=60)
        transport.auth_none("root")
    except BaseException:
        transport.close()
        raise
    return transport


def run(transport: paramiko.Transport, command: str) -> str:
    channel = transport.open_session(timeout=60)
    channel.settimeout(60)
    channel.exec_command(command)
    with channel.makefile("rb") as output:
        text: bytes = output.read()
    channel.close()
    return text.decode()


def answers(endpoint: Endpoint) -> bool:
    """Whether a login at the endpoint works."""
    try:
        connect(endpoint).close()
    except (OSError, paramiko.SSHException, EOFError):
        return False
    return True


def flash_text(node: VirtualNode, path: str) -> str | None:
    """The content of a file that would survive a power cut."""
    file = Path(f"{node.flash_path}{path}")
    return file.read_text(encoding="utf-8") if file.exists() else None
