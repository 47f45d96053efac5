"""Pure parts of the machine: archives, modules, traffic control, and the kernel's target state."""

from __future__ import annotations

import io
import subprocess
from ipaddress import IPv4Interface
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshlab import rootfs
from meshlab.errors import LabError
from meshlab.qemu import cpio, guest_protocol, hwsim_devices, initramfs, kernel_modules, qemu, traffic_control
from meshlab.qemu.traffic_control import Impairment
from meshlab.spec import FleetSpec, LanSpec, Medium, NodeSpec, RadioSpec, dump, load

REAL_ROOT = Path(initramfs.__file__).with_name("node_root")


def entries(archive: bytes) -> dict[str, tuple[int, bytes]]:
    """The kernel's reading of a newc archive: mode and content by name."""
    found: dict[str, tuple[int, bytes]] = {}
    at = 0
    while True:
        assert archive[at : at + 6] == b"070701"
        fields = [int(archive[at + 6 + 8 * n : at + 14 + 8 * n], 16) for n in range(13)]
        name = archive[at + 110 : at + 110 + fields[11] - 1].decode()
        at += -(-(110 + fields[11]) // 4) * 4
        if name == "TRAILER!!!":
            return found
        assert fields[2:4] == [0, 0], "everything is root's"
        found[name] = (fields[1], archive[at : at + fields[6]])
        at += -(-fields[6] // 4) * 4


@given(st.dictionaries(st.text("abc", min_size=1, max_size=6), st.binary(max_size=40), max_size=5))
def test_an_archive_holds_every_file_folder_and_link(
    tmp_path_factory: pytest.TempPathFactory, files: dict[str, bytes]
) -> None:
    root = tmp_path_factory.mktemp("tree")
    (root / "folder").mkdir(mode=0o755)
    (root / "folder" / "link").symlink_to("elsewhere")
    for name, content in files.items():
        (root / f"f-{name}").write_bytes(content)
    out = io.BytesIO()
    cpio.write(root, out)
    found = entries(out.getvalue())
    assert {name: content for name, (mode, content) in found.items() if mode & 0o170000 == 0o100000} == {
        f"f-{name}": content for name, content in files.items()
    }
    assert found["folder"][0] == 0o040755
    assert found["folder/link"][0] & 0o170000 == 0o120000
    assert found["folder/link"][1] == b"elsewhere"
    assert len(out.getvalue()) % 512 == 0


def test_kernel_modules_are_loaded_after_their_dependencies(tmp_path: Path) -> None:
    for name, needs in {
        "mac80211_hwsim": "mac80211",
        "mac80211": "cfg80211,libarc4",
        "cfg80211": "",
        "libarc4": "",
    }.items():
        (tmp_path / f"{name}.ko").write_bytes(b"\x7fELF\0license=GPL\0depends=" + needs.encode() + b"\0name=x\0")
    names = [path.stem for path in kernel_modules.in_order(tmp_path, ("mac80211_hwsim", "built_in"))]
    assert names == ["cfg80211", "libarc4", "mac80211", "mac80211_hwsim"]


def test_a_kernel_without_virtual_radios_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LabError, match="no mac80211_hwsim"):
        kernel_modules.in_order(tmp_path)


@given(st.integers(0, 2), st.binary(max_size=200))
def test_a_frame_header_has_stream_and_length(stream: int, content: bytes) -> None:
    sent = guest_protocol.frame(stream, content)
    assert guest_protocol.header(sent[: guest_protocol.HEADER_BYTES]) == (stream, len(content))
    assert sent[guest_protocol.HEADER_BYTES :] == content


def test_unicast_loss_accounts_for_retries() -> None:
    lines = traffic_control.batch(
        "mesh0", {"02:00:00:00:00:01": Impairment(loss=0.5, delay_ms=5, rate_kbps=1000)}
    ).splitlines()
    qdiscs = [line for line in lines if "netem" in line]
    assert "delay 5ms loss 50.0000% rate 1000kbit" in qdiscs[0]
    assert "loss 0.7812%" in qdiscs[1]
    senders = [line for line in lines if "dev air-mesh0" in line and "src_mac 02:00:00:00:00:01" in line]
    assert "dst_mac 01:00:00:00:00:00/01:00:00:00:00:00 classid 1:3" in senders[0]
    assert senders[1].endswith("classid 1:4")


def test_broadcasts_and_unicast_frames_of_a_link_share_its_rate_and_a_broadcast_takes_longer() -> None:
    impairment = Impairment(rate_kbps=6000, broadcast_kbps=1000)
    lines = traffic_control.batch("mesh0", {"02:00:00:00:00:01": impairment}).splitlines()
    parents = [line.split("parent ")[1].split()[0] for line in lines if line.startswith("class ")]
    assert parents == ["1:", "1:2", "1:2"]
    shared, *both = [line for line in lines if line.startswith("class ")]
    assert "classid 1:2 htb rate 6000kbit" in shared
    assert all("ceil 6000kbit" in line and "quantum 9600" in line for line in both)
    copies = [line for line in lines if "dev mesh0" in line and "flower" in line]
    assert [line.count("mirred egress mirror") for line in copies] == [5]
    assert [line.count("mirred egress redirect") for line in copies] == [1]


@pytest.mark.parametrize(
    ("rate_kbps", "broadcast_kbps", "copies"),
    [(None, 1000, 1), (6000, None, 1), (6000, 6000, 1), (1000, 6000, 1), (6000, 4000, 2), (10**7, 1, 24)],
)
def test_a_broadcast_is_never_faster_than_a_unicast_frame(
    rate_kbps: int | None, broadcast_kbps: int | None, copies: int
) -> None:
    assert Impairment(rate_kbps=rate_kbps, broadcast_kbps=broadcast_kbps).broadcast_copies == copies


def test_no_qdisc_is_configured_without_an_impairment() -> None:
    assert traffic_control.batch("mesh0", {}) == ""
    assert Impairment().is_none


def fleet() -> FleetSpec:
    radios = (RadioSpec(), RadioSpec(name="radio1"))
    nodes = (NodeSpec("base", medium=Medium.BASE), NodeSpec("husky", radios=radios), NodeSpec("b01"))
    lans = (LanSpec("station", ("base",), "10.42.0.2/24"), LanSpec("husky", ("husky",)))
    return FleetSpec("x", nodes, lans=lans)


def test_radios_are_numbered_consecutively_and_each_node_has_its_lan() -> None:
    places = hwsim_devices.node_hardware(fleet())
    assert [place.phys for place in places.values()] == [("phy0",), ("phy1", "phy2"), ("phy3",)]
    assert [place.lan.name if place.lan else None for place in places.values()] == ["station", "husky", None]
    operator = hwsim_devices.operator_lan(fleet())
    assert operator is not None
    assert operator.name == "station"


def test_a_spec_with_lans_round_trips_through_dump_and_load() -> None:
    assert load(dump(fleet())) == fleet()


@given(st.integers(0, 2**32 - 1), st.integers(8, 29), st.integers(0, 40))
def test_the_operators_bench_address_is_in_the_nodes_network_but_differs_from_its_address(
    ip: int, prefix: int, number: int
) -> None:
    node = IPv4Interface((ip, prefix))
    operator = hwsim_devices.operator_address(node, number)
    assert operator.network == node.network
    assert operator.ip != node.ip


def test_without_a_kvm_device_the_machine_is_emulated(tmp_path: Path) -> None:
    assert qemu.probe_accelerator(tmp_path / "no-kernel", tmp_path / "no-kvm") is qemu.TCG


CONFIG = """package network

config interface 'lan'
\toption device 'br-lan'
\toption proto 'static'
\toption ipaddr '10.42.0.11'
\toption netmask '255.255.255.0'

config device 'br'
\toption name 'br-lan'
\toption type 'bridge'
\tlist ports 'eth0'
\tlist ports 'bat0'

config interface 'bat0'
\toption proto 'batadv'
\toption routing_algo 'BATMAN_V'
\toption orig_interval '500'

config interface 'mesh0'
\toption proto 'batadv_hardif'
\toption master 'bat0'
\toption mtu '1536'

package wireless

config wifi-device 'radio0'
\toption path 'platform/ahb/18100000.wmac'
\toption band '2g'
\toption channel '{channel}'
\toption htmode 'HT20'
\toption txpower '24'

config wifi-iface 'mesh0'
\toption device 'radio0'
\toption network 'mesh0'
\toption ifname 'mesh0'
\toption mode 'adhoc'
\toption ssid 'a team'
\toption bssid '02:ca:fe:00:00:01'
\toption mcast_rate '12000'
"""


def planned(run: Path, config: str) -> list[list[str]]:
    """The kernel's target state from netifd's stand-in, as lines of fields; state is kept in one directory."""
    run.mkdir(exist_ok=True)
    awk = rootfs.STAND_INS / "lab" / "netifd.awk"
    variables = {
        "mode": "up", "series": "23.05", "radios": "radio0,platform/ahb/18100000.wmac,2g,02:4d:00:00:00:10,27",
        "ports": "eth0", "lan_mac": "02:4d:00:00:00:00", "batman": "1", "ibss_rsn": "", "now": "5", "run": str(run),
        "phase": "2",
    }  # fmt: skip
    words = [word for name, value in variables.items() for word in ("-v", f"{name}={value}")]
    busybox = rootfs.find_program("busybox", "busybox-static")
    subprocess.run(
        (busybox, "awk", *words, "-f", awk, "-f", REAL_ROOT / "lab" / "netifd_kernel.awk"),
        input=config, text=True, check=True, timeout=60,
    )  # fmt: skip
    (run / "radios.new").replace(run / "radios")
    return [line.split("\t") for line in (run / "kernel.new").read_text().splitlines()]


def test_kernel_devices_are_planned_from_uci_files_in_creation_order(tmp_path: Path) -> None:
    plan = planned(tmp_path / "run", CONFIG.format(channel=6))
    assert [line[:2] for line in plan] == [
        ["soft", "bat0"], ["radio", "mesh0"], ["tune", "mesh0"], ["bridge", "br-lan"], ["port", "br-lan"],
        ["port", "br-lan"], ["hard", "mesh0"], ["addr", "br-lan"],
    ]  # fmt: skip
    assert plan[0][2:] == ["BATMAN_V", "orig_interval=500", "-"]
    assert plan[1][2:9] == ["0", "adhoc", "2437", "HT20", "a team", "02:ca:fe:00:00:01", "12000"]
    assert plan[2][2:5] == ["0", "24", "-"]
    assert plan[6][2:4] == ["bat0", "1536"]
    assert plan[7][2] == "10.42.0.11/24"


def test_a_channel_change_recreates_only_the_radio_and_its_dependents(tmp_path: Path) -> None:
    before = planned(tmp_path / "run", CONFIG.format(channel=6))
    assert planned(tmp_path / "run", CONFIG.format(channel=6)) == before
    after = planned(tmp_path / "run", CONFIG.format(channel=11))
    changed = [line for line in after if line not in before]
    assert [line[:2] for line in changed] == [["radio", "mesh0"], ["tune", "mesh0"], ["hard", "mesh0"]]
    # another creation number, and the other address, because the old interface still exists when it is chosen
    assert [(line[9], line[10]) for line in (before[1], changed[0])] == [
        ("21", "02:4d:00:00:00:10"), ("22", "42:4d:00:00:00:10"),
    ]  # fmt: skip


def test_a_tx_power_change_is_applied_in_place(tmp_path: Path) -> None:
    before = planned(tmp_path / "run", CONFIG.format(channel=6))
    after = planned(tmp_path / "run", CONFIG.format(channel=6).replace("txpower '24'", "txpower '10'"))
    assert [line[:5] for line in after if line not in before] == [["tune", "mesh0", "0", "10", "-"]]


@pytest.mark.parametrize("script", sorted(path.name for path in (REAL_ROOT / "lab").iterdir() if path.is_file()))
def test_busybox_ash_parses_every_stand_in_script(script: str) -> None:
    path = REAL_ROOT / "lab" / script
    if path.read_bytes().startswith(b"#!/bin/sh"):
        subprocess.run((rootfs.find_program("busybox", "busybox-static"), "ash", "-n", path), check=True, timeout=60)
    else:
        assert path.suffix == ".awk"


def test_only_the_first_base_is_always_on_the_operator_s_lan() -> None:
    """Two factory devices on one LAN both answer at 192.168.1.1: bootstrap took one for the other."""
    names = ("gate-a", "gate-b", "second", "crane")
    nodes = tuple(NodeSpec(name, medium=Medium.BENCH if name == "crane" else Medium.BASE) for name in names)
    spec = FleetSpec("harbor", nodes, lans=(LanSpec("office", ("gate-a", "second")), LanSpec("crane", ("crane",))))
    hardware = hwsim_devices.node_hardware(spec)
    assert [name for name in names if hwsim_devices.is_on_operator_lan(hardware[name], spec)] == ["gate-a"]
    alone = FleetSpec("no-robots", (NodeSpec("base", medium=Medium.BASE),))
    assert not hwsim_devices.is_on_operator_lan(hwsim_devices.node_hardware(alone)["base"], alone)
