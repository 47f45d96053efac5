"""A node's output as facts: recorded outputs of every release, the real script on a real ash, and any other text.

The cases in recorded/ were composed after the tools' sources (docs/facts/openwrt-facts.md, section 5), not captured.
"""

from __future__ import annotations

import dataclasses
import gzip
import json
import random
import re
from collections.abc import Mapping
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.device import deadman
from meshctl.device.framing import framed
from meshctl.device.observation import Observation, Originator
from meshctl.device.observe import interpret, observation_script, observe
from meshctl.device.parse import batctl, iw, keys, packages, system, ubus
from meshctl.device.parse.deadman import parse_answer, parse_status
from meshctl.device.parse.sections import MAX_INFLATED_BYTES, OutputSection, split_sections
from meshctl.device.scripts import script
from meshctl.device.ssh import SshConnection
from meshctl.device.ssh_channel import MAX_INLINE_STDIN_BYTES, MAX_OUTPUT_BYTES
from meshctl.model import RELEASES
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import host_key

RECORDED = Path(__file__).parent / "recorded"
CASES = sorted(RECORDED.glob("*/*"))


def observed(case: Path) -> Observation:
    sections = split_sections((case / "observe.out").read_bytes(), "NONCE")
    return interpret(sections, asked_at_s=1785311990.0, answered_at_s=1785311994.0)


def as_json(value: object) -> object:
    """Dataclasses, named tuples and mappings as JSON writes them."""
    if isinstance(value, Originator):
        return as_json(value._asdict())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: as_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): as_json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [as_json(item) for item in value]
    return value


@pytest.mark.parametrize("case", CASES, ids=lambda case: "/".join(case.parts[-2:]))
def test_a_recorded_node_gives_exactly_the_expected_facts(case: Path) -> None:
    assert as_json(observed(case)) == json.loads((case / "expected.json").read_text())


def test_every_supported_release_is_recorded() -> None:
    assert {case.parent.name for case in CASES} == {release.value for release in RELEASES}


@pytest.mark.parametrize("release", [release.value for release in RELEASES])
def test_the_facts_a_plan_needs_are_there_for_every_release(release: str) -> None:
    seen = observed(RECORDED / release / "mesh")
    assert seen.notes == ()
    assert seen.release is not None
    assert seen.release.version.startswith(release)
    assert seen.board is not None
    assert seen.board.board_name
    assert seen.board.lan_ports
    assert seen.mesh is not None
    assert seen.mesh.hard_interfaces == ("mesh0",)
    assert seen.neighbors is not None
    assert {neighbor.ifname for neighbor in seen.neighbors} == {"mesh0"}
    assert seen.originators is not None
    assert [path.best for path in seen.originators].count(True) == 3
    assert seen.links is not None
    assert seen.links[0].joined
    assert seen.packages is not None
    assert "batctl-full" in seen.packages
    assert seen.host_keys
    assert seen.clock_offset_s == 8.0


def test_an_empty_answer_is_an_empty_observation_with_a_note_for_each_fact() -> None:
    seen = interpret({}, asked_at_s=0.0, answered_at_s=1.0)
    document = as_json(seen)
    assert isinstance(document, dict)
    assert {name for name, value in document.items() if value is not None} == {
        "asked_at_s",
        "answered_at_s",
        "files",
        "notes",
    }
    assert "the observation was cut short" in seen.notes
    assert len(seen.notes) > 10


@given(st.integers(0, 60_000))
def test_an_answer_cut_anywhere_is_still_an_observation(at: int) -> None:
    whole = (RECORDED / "24.10" / "mesh" / "observe.out").read_bytes()
    seen = interpret(split_sections(whole[:at], "NONCE"), asked_at_s=0.0, answered_at_s=0.0)
    if at < len(whole) - 10:
        assert "the observation was cut short" in seen.notes


PARSERS = [
    ubus.parse_board,
    ubus.parse_wireless,
    ubus.parse_interfaces,
    ubus.parse_board_json,
    system.parse_openwrt_release,
    system.parse_uptime,
    system.parse_clock,
    system.parse_boot_id,
    system.parse_load,
    system.parse_meminfo,
    system.parse_df,
    system.parse_macs,
    system.parse_indexes,
    system.parse_bridges,
    system.parse_mode,
    iw.parse_iw_dev,
    iw.parse_stations,
    iw.parse_survey,
    iw.parse_phys,
    system.parse_phys,
    batctl.parse_statistics,
    batctl.parse_transglobal,
    system.parse_sensors,
    batctl.parse_mesh_json,
    batctl.parse_mesh_header,
    batctl.parse_interfaces_text,
    batctl.parse_neighbors_text,
    batctl.parse_originators_text,
    lambda text: batctl.parse_hardifs_json(text, {}),
    lambda text: batctl.parse_neighbors_json(text, {}),
    lambda text: batctl.parse_originators_json(text, {}),
    packages.parse_packages,
    packages.parse_package_tool,
    keys.parse_authorized_keys,
    keys.parse_host_keys,
    parse_status,
    parse_answer,
]

SECTIONS = [split_sections((case / "observe.out").read_bytes(), "NONCE") for case in CASES]
SAMPLES = [section.text for sections in SECTIONS for section in sections.values()]
NAMES = sorted({name for sections in SECTIONS for name in sections})
KEYS = ["interface", "config", "interfaces", "release", "network", "lan", "hard_ifindex", "tq", "best", "ipv4-address"]

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=4),
    max_leaves=12,
)
spoiled = st.builds(
    lambda text, at, instead: text[:at] + instead + text[at + 1 :],
    st.sampled_from(SAMPLES),
    st.integers(0, 2000),
    st.text(max_size=4),
)


@given(st.one_of(st.text(), json_values.map(json.dumps), spoiled))
def test_no_parser_raises_on_arbitrary_text(text: str) -> None:
    for parse in PARSERS:
        parse(text)
    for link in iw.parse_iw_dev(text) or ():
        iw.with_link(link, text)


@given(st.dictionaries(st.sampled_from(NAMES), st.builds(OutputSection, st.binary(max_size=80), st.integers(-1, 255))))
def test_arbitrary_sections_yield_an_observation(sections: dict[str, OutputSection]) -> None:
    assert interpret(sections, asked_at_s=0.0, answered_at_s=0.0).asked_at_s == 0.0


@given(st.lists(st.binary(max_size=30).filter(lambda body: b"NONCE" not in body), max_size=5))
def test_sections_keep_every_byte(bodies: list[bytes]) -> None:
    output = b"".join(b"NONCE begin s%d\n%s\nNONCE end %d\n" % (n, body, n) for n, body in enumerate(bodies))
    assert split_sections(output, "NONCE") == {f"s{n}": OutputSection(body, n) for n, body in enumerate(bodies)}


@given(st.integers(0, 60_000))
def test_a_compressed_answer_is_read_like_any_other_wherever_it_is_cut(at: int) -> None:
    whole = (RECORDED / "24.10" / "mesh" / "observe.out").read_bytes()
    packed = b"a banner\nNONCE gzip\n" + gzip.compress(whole, mtime=0)
    cut = split_sections(packed[:at], "NONCE")
    every = split_sections(whole, "NONCE")
    if at >= len(packed):
        assert cut == every
        return
    # the last one may be cut, even in its name
    complete = list(cut)[:-1]
    assert complete == list(every)[: len(complete)]
    assert all(cut[name] == every[name] for name in complete)


def test_the_originators_of_a_large_mesh_shrink_to_a_tenth() -> None:
    chance = random.Random(1)
    macs = [f"02:15:6d:{chance.randrange(1 << 24):06x}" for _ in range(220)]
    rows = [
        {"hard_ifindex": 7, "hard_ifname": "mesh0", "orig_address": mac, "last_seen_msecs": chance.randrange(1000),
         "neigh_address": macs[via], "tq": chance.randrange(1, 256)}
        for mac in macs
        for via in range(4)
    ]  # fmt: skip
    table = json.dumps(rows).encode()
    assert len(table) > 100_000
    assert len(gzip.compress(table, 6)) < len(table) / 10


@pytest.mark.parametrize("packed", [b"", b"no gzip", gzip.compress(b"", mtime=0)[:5], b"\x1f\x8b" + bytes(40)])
def test_what_is_not_compressed_although_it_says_so_has_no_sections(packed: bytes) -> None:
    assert split_sections(b"NONCE gzip\n" + packed, "NONCE") == {}


def test_a_compressed_answer_is_inflated_up_to_the_limit_of_an_answer() -> None:
    bomb = gzip.compress(b"NONCE begin uptime\n" + bytes(4 * MAX_INFLATED_BYTES))
    assert MAX_INFLATED_BYTES == MAX_OUTPUT_BYTES
    (section,) = split_sections(b"NONCE gzip\n" + bomb, "NONCE").values()
    assert len(section.body) < MAX_INFLATED_BYTES


def test_section_markers_without_the_nonce_are_ignored() -> None:
    output = b"NONCE begin config x\nother begin authorized_keys\nevil\nother end 0\n\nNONCE end 0\n"
    assert list(split_sections(output, "NONCE")) == ["config x"]


def test_the_script_runs_on_the_real_ash_and_reports_the_facts(connection: SshConnection, node: Sandbox) -> None:
    node.put("/etc/config/network", "config interface 'lan'\n\toption ipaddr '192.168.1.1'\n\n")
    node.put("/etc/config/odd", b"\xff\xfe no text")
    node.put("/etc/openwrt_release", "DISTRIB_ID='OpenWrt'\nDISTRIB_RELEASE='24.10.5'\nDISTRIB_REVISION='r1'\n")
    node.put("/tmp/sysinfo/board_name", "ubnt,rocket-m\n")
    node.put("/usr/lib/opkg/status", OPKG_STATUS)
    node.put("/usr/bin/opkg", "#!/bin/sh\nexit 1\n", 0o755)
    node.put("/tmp/.uci/delta", "network.lan.ipaddr='10.0.0.9'\n")
    node.put("/etc/secret.bin", bytes(range(256)), 0o600)
    node.put("/etc/large", "x" * 70_000)
    paths = ["/etc/secret.bin", "/etc/large", "/etc/nowhere", "/etc/init.d/meshctl-deadman"]
    seen = observe(connection, extra_paths=paths)
    assert seen.boot_id == (node.text("/harness/boot_id") or "").strip()
    assert seen.uptime_s is not None
    assert seen.release is not None
    assert seen.release.version == "24.10.5"
    assert seen.board is not None
    assert seen.board.board_name == "ubnt,rocket-m"
    assert seen.uci is not None
    assert set(seen.uci) == {"network", "odd"}
    assert seen.uci["network"] == "config interface 'lan'\n\toption ipaddr '192.168.1.1'\n\n"
    assert seen.uci["odd"] == "\ufffd\ufffd no text"
    assert seen.uci_changes == ("network.lan.ipaddr='10.0.0.9'",)
    assert seen.package_tool == "opkg"
    assert seen.packages == {"base-files": "1650-r1", "iw": "6.9-r1"}
    assert seen.memory is not None
    assert seen.macs is not None
    assert "lo" in seen.macs
    assert seen.authorized_keys is not None
    assert len(seen.authorized_keys) == 1
    assert seen.mesh is None
    assert seen.change is not None
    assert (seen.change.state, seen.change.version) == ("idle", deadman.version())
    assert seen.is_first_boot is False
    secret, large, nowhere, init = (seen.files[path] for path in paths)
    assert secret is not None
    assert (secret.mode, secret.text) == (0o600, None)
    assert large is not None
    assert (large.text, len(large.sha256)) == (None, 64)
    assert nowhere is None
    assert init is not None
    assert init.text is not None
    assert init.text.startswith("#!/bin/sh /etc/rc.common")
    assert seen.asked_at_s <= seen.answered_at_s


OPKG_STATUS = """\
Package: base-files
Version: 1650-r1
Depends: libc
Status: install user installed
Architecture: mips_24kc

Package: gone
Version: 1
Status: deinstall ok not-installed

Package: iw
Version: 6.9-r1
Status: install user installed
Auto-Installed: yes
"""


@pytest.mark.parametrize(
    ("answer", "packages"),
    [("Permission denied", ("network", "wireless")), ("No response", ()), ("Not found", ())],
)
def test_a_change_that_luci_has_to_confirm_is_seen(
    answer: str, packages: tuple[str, ...], connection: SshConnection, node: Sandbox
) -> None:
    """The plan said that the node would change; its dead-man's switch refused that."""
    assert observe(connection).unconfirmed_packages is None
    for package in ("wireless", "network"):
        node.put(f"/var/run/rpcd/snapshot-files/{package}", "config x\n")
    node.put("/bin/ubus", f"#!/bin/sh\n[ \"$5\" != confirm ] || {{ echo '{answer}' >&2; exit 5; }}\n", 0o755)
    assert observe(connection).unconfirmed_packages == packages


def test_a_brief_observation_has_what_a_proof_needs(connection: SshConnection, node: Sandbox) -> None:
    node.put("/etc/config/network", "config interface 'lan'\n")
    node.put("/usr/lib/opkg/status", OPKG_STATUS)
    node.put("/usr/bin/opkg", "#!/bin/sh\nexit 1\n", 0o755)
    full, brief = observe(connection), observe(connection, brief=True)
    assert brief.boot_id == full.boot_id
    assert brief.macs == full.macs
    assert brief.packages == full.packages
    assert brief.change is not None
    assert (full.clock_s is None, brief.clock_s is None) == (False, True)
    assert brief.overlay is None


def test_an_apk_database_is_read_by_the_script(connection: SshConnection, node: Sandbox) -> None:
    node.put("/usr/bin/apk", "#!/bin/sh\nexit 1\n", 0o755)
    node.put("/lib/apk/db/installed", "C:Q1x\nP:batctl-full\nV:2025.4-r1\nA:mips_24kc\n\nP:iw\nV:6.17-r1\n\n")
    seen = observe(connection)
    assert seen.package_tool == "apk"
    assert seen.packages == {"batctl-full": "2025.4-r1", "iw": "6.17-r1"}


# As the real one: `wpa_supplicant.*` matches no object where the supplicant runs no interface, which is an error.
TRANSGLOBAL = """\
 * 66:0f:2c:9e:01:0c   -1 [....] (  3) 02:15:6d:00:00:21 (  3) (0x8b1d5a3f)
   66:0f:2c:9e:01:0c    1 [.W..] (  3) 02:15:6d:00:00:22 (  3) (0x8b1d5a3f)
 * 33:33:00:00:00:fb   -1 [....] (  1) 02:15:6d:00:00:22 (  2) (0x00000000)
"""


@pytest.mark.parametrize(
    ("prints", "status", "counted"),
    [(TRANSGLOBAL, 0, (2, 1)), ("", 0, (0, 0)), ("", 254, None), (TRANSGLOBAL, 1, None)],
    ids=["entries", "empty", "failed", "failed midway"],
)
def test_the_translation_table_is_counted_on_the_node(
    node: Sandbox, prints: str, status: int, counted: tuple[int, int] | None
) -> None:
    node.put("/harness/table", prints)
    asked = 'echo "$*" >/harness/asked'
    node.put("/usr/sbin/batctl", f"#!/bin/sh\n{asked}\ncat /harness/table\nexit {status}\n", 0o755)
    function = re.search(r"^transglobal\(\) .*?^}$", script("observe.sh"), re.MULTILINE | re.DOTALL)
    assert function is not None
    done = node.run("sh", "-c", f"{function[0]}\ntransglobal meshif bat0")
    assert node.text("/harness/asked") == "meshif bat0 transglobal -H -n\n"
    assert (done.returncode == 0) == (counted is not None)
    assert batctl.parse_transglobal(done.stdout) == counted


def test_host_keys_are_fingerprinted_as_a_client_sees_them(connection: SshConnection, node: Sandbox) -> None:
    line = node.text("/etc/dropbear/ed25519.pub") or ""
    node.put("/usr/bin/dropbearkey", f"#!/bin/sh\necho Public key portion is:\necho '{line.strip()}'\n", 0o755)
    seen = observe(connection)
    assert seen.host_keys is not None
    assert [known.fingerprint for known in seen.host_keys] == [host_key(node).fingerprint]


def test_relative_paths_and_shell_metacharacters_are_rejected() -> None:
    for path in ("/etc/a b", "/etc/$(reboot)", "relative", "/etc/a;b"):
        with pytest.raises(ValueError, match="absolute path"):
            observation_script("nonce", [path])


@pytest.mark.parametrize(
    ("listed", "mode"),
    [
        ("-rw-r--r--    1 0        0    5 Jan  1 00:00 /x", 0o644),
        ("-rwsr-x--t    1 0        0    5 Jan  1 00:00 /x", 0o5751),
        ("lrwxrwxrwx    1 0        0    5 Jan  1 00:00 /x -> y", 0o777),
        ("-rw------S", None),
        ("", None),
    ],
)
def test_modes_are_read_from_ls(listed: str, mode: int | None) -> None:
    assert system.parse_mode(listed) == mode


def test_the_output_of_apk_list_is_parsed() -> None:
    text = (
        "batctl-full-2025.4-r1 mips_24kc {feeds/routing/batctl} (GPL-2.0-only) [installed]\n"
        "libubox20240329-2024.03.29~eb9bcb64-r1 mips_24kc {libubox} (ISC) [installed]\n"
    )
    assert packages.parse_packages(text) == {
        "batctl-full": "2025.4-r1",
        "libubox20240329": "2024.03.29~eb9bcb64-r1",
    }


_MACS = st.sampled_from(["02:00:00:00:00:01", "02:00:00:00:00:0A", "", 7, None])
_NUMBERS = st.sampled_from([0, 120, 255, 1.5, True, "250", None])
_ROWS = st.fixed_dictionaries(
    {"orig_address": _MACS, "neigh_address": _MACS, "hard_ifname": st.sampled_from(["mesh0", "", "Mesh0", None])},
    optional={
        "hard_ifindex": st.sampled_from([7, 8, None]),
        "last_seen_msecs": _NUMBERS,
        "best": st.sampled_from([True, False, 1]),
        "tq": _NUMBERS,
        "throughput": _NUMBERS,
    },
)


@given(st.lists(_ROWS | st.sampled_from([{}, [], "row", None]), max_size=6))
def test_a_table_of_originators_reads_the_same_as_its_rows_alone(rows: list[object]) -> None:
    # an unusual row next to it makes the whole table be read row by row
    unusual = {"orig_address": "02:00:00:00:00:0F", "last_seen_msecs": 1.5}
    names = {7: "mesh7"}
    whole = batctl.parse_originators_json(json.dumps(rows), names)
    with_unusual = batctl.parse_originators_json(json.dumps([*rows, unusual]), names)
    assert whole is not None
    assert with_unusual == (*whole, Originator("02:00:00:00:00:0f", "", "", 1, best=False))


def test_batman_v_tables_give_throughput() -> None:
    text = (
        "[B.A.T.M.A.N. adv 2019.2-openwrt-9, MainIF/MAC: mesh0/02:00:00:00:00:01 (bat0/66:00:00:00:00:01 BATMAN_V)]\n"
        "   Originator        last-seen ( throughput)  Nexthop           [outgoingIF]\n"
        " * 02:00:00:00:00:02    0.460s (       10.4)  02:00:00:00:00:02 [     mesh0]\n"
    )
    (path,) = batctl.parse_originators_text(text) or ()
    assert (path.throughput_kbit_s, path.tq, path.best, path.last_seen_ms) == (10_400, None, True, 460)
    near = (
        "         Neighbor   last-seen      speed           IF\n"
        "02:00:00:00:00:02    0.460s (       10.4) [     mesh0]\n"
    )
    (neighbor,) = batctl.parse_neighbors_text(near) or ()
    assert (neighbor.mac, neighbor.ifname, neighbor.last_seen_ms) == ("02:00:00:00:00:02", "mesh0", 460)


@pytest.mark.parametrize(
    ("bitrate", "mcs"),
    [
        ("144.4 MBit/s MCS 15 short GI", "MCS 15"),
        ("866.7 MBit/s VHT-MCS 9 80MHz short GI VHT-NSS 2", "VHT-MCS 9 NSS 2"),
        ("1200.9 MBit/s 80MHz HE-MCS 11 HE-NSS 2 HE-GI 0 HE-DCM 0", "HE-MCS 11 NSS 2"),
        ("2882.3 MBit/s 160MHz EHT-MCS 13 EHT-NSS 2 EHT-GI 0", "EHT-MCS 13 NSS 2"),
        ("1.0 MBit/s", ""),
        ("(unknown)", ""),
    ],
)
def test_the_mcs_of_every_generation_is_read(bitrate: str, mcs: str) -> None:
    text = f"Station 02:00:00:00:00:01 (on mesh0)\n\tsignal:  \t-60 dBm\n\ttx bitrate:\t{bitrate}\n"
    (station,) = iw.parse_stations(text) or ()
    assert (station.tx_mcs, station.rx_mcs, station.chain_signals_dbm) == (mcs, "", ())


def test_the_survey_is_that_of_the_channel_in_use() -> None:
    other = "Survey data from mesh0\n\tfrequency:\t\t\t2412 MHz\n\tnoise:\t\t\t\t-90 dBm\n"
    used = other.replace("2412 MHz", "2437 MHz [in use]") + "\tchannel active time:\t\t70 ms\n"
    survey = iw.parse_survey(other + used + other)
    assert survey is not None
    assert (survey.frequency_mhz, survey.noise_dbm, survey.active_ms, survey.busy_ms) == (2437, -90, 70, None)
    assert iw.parse_survey(other) is None


def test_a_root_in_memory_is_distinguished_from_one_in_flash() -> None:
    ram = "/dev/root /rom squashfs ro 0 0\noverlayfs:/tmp/root / overlay rw,noatime 0 0\n"
    assert system.parse_first_boot(ram)
    assert not system.parse_first_boot(ram.replace("overlayfs:/tmp/root", "overlayfs:/overlay"))


def test_a_root_that_cannot_be_written_is_recognized() -> None:
    rom = "/dev/root / squashfs ro,relatime 0 0\n"
    assert system.parse_read_only_root(rom)
    # the last mount on / is the one in use, as after `mount_root` in failsafe mode
    assert not system.parse_read_only_root(rom + "overlayfs:/overlay / overlay rw,lowerdir=/,upperdir=/ro 0 0\n")
    assert system.parse_read_only_root("/dev/sda2 / ext4 ro,noatime 0 0\n")
    assert not system.parse_read_only_root("")


def test_a_node_without_a_package_manager_has_one_note_that_says_so() -> None:
    sections = split_sections((RECORDED / "24.10" / "mesh" / "observe.out").read_bytes(), "NONCE")
    without = {**sections, "package_tool": OutputSection(b"", 127), "packages": OutputSection(b"", 127)}
    seen = interpret(without, asked_at_s=1785311990.0, answered_at_s=1785311994.0)
    assert seen.notes == ("no package manager: neither apk nor opkg was found",)
    assert (seen.package_tool, seen.packages) == (None, None)


def test_the_script_fits_in_the_window_of_its_channel() -> None:
    """So it is sent at once, by no thread of its own, to each node of a fleet."""
    paths = [
        "/etc/meshctl/node",
        "/etc/meshctl/lan-filter.sh",
        "/etc/meshctl/links.sh",
        "/etc/dropbear/authorized_keys",
    ]
    sent = framed(observation_script("meshctl-" + 32 * "0", paths))
    assert len(sent.preamble) <= MAX_INLINE_STDIN_BYTES
