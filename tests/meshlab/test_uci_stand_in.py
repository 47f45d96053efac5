"""uci's stand-in against uci's recorded behavior (docs/facts/openwrt-facts.md sections 1 and 4)."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshlab.rootfs import STAND_INS, find_program

BUSYBOX = find_program("busybox", "busybox-static")
NETWORK = """
config interface 'loopback'
	option device 'lo'
	option proto 'static'

config device
	option name 'br-lan'
	option type 'bridge'
	list ports 'eth0'
	list ports 'eth1'

config interface 'lan'
	option device 'br-lan'
	option ipaddr '192.168.1.1'

"""


class Uci:
    """Runs the stand-in in its own directory."""

    def __init__(self, directory: Path) -> None:
        self.config = directory / "config"
        self.delta = directory / "delta"
        self.config.mkdir()

    def run(self, *arguments: str, stdin: str = "") -> subprocess.CompletedProcess[str]:
        command: Sequence[str] = (
            str(BUSYBOX), "awk", "-f", f"{STAND_INS}/lab/uci_tree.awk", "-f", f"{STAND_INS}/lab/uci.awk", "--",
            "-c", str(self.config), "-P", str(self.delta), *arguments,
        )  # fmt: skip
        return subprocess.run(command, input=stdin, capture_output=True, text=True, check=False)

    def out(self, *arguments: str, stdin: str = "") -> str:
        done = self.run(*arguments, stdin=stdin)
        assert done.returncode == 0, done.stderr
        return done.stdout


@pytest.fixture
def uci(tmp_path: Path) -> Uci:
    made = Uci(tmp_path)
    (made.config / "network").write_text(NETWORK, encoding="utf-8")
    return made


def test_show_names_anonymous_sections_by_type_and_index(uci: Uci) -> None:
    assert uci.out("show", "network").splitlines() == [
        "network.loopback=interface",
        "network.loopback.device='lo'",
        "network.loopback.proto='static'",
        "network.@device[0]=device",
        "network.@device[0].name='br-lan'",
        "network.@device[0].type='bridge'",
        "network.@device[0].ports='eth0' 'eth1'",
        "network.lan=interface",
        "network.lan.device='br-lan'",
        "network.lan.ipaddr='192.168.1.1'",
    ]


def test_show_x_prints_internal_names_of_anonymous_sections(uci: Uci) -> None:
    lines = uci.out("-X", "show", "network").splitlines()
    assert lines[3].startswith("network.cfg02")


def test_get_gives_a_type_a_value_or_a_list(uci: Uci) -> None:
    assert uci.out("get", "network.lan") == "interface\n"
    assert uci.out("get", "network.lan.ipaddr") == "192.168.1.1\n"
    assert uci.out("get", "network.@device[-1].ports") == "eth0 eth1\n"


@pytest.mark.parametrize("path", ["network.wan", "network.lan.gateway", "wireless.radio0", "network.@device[1].name"])
def test_getting_a_missing_entry_is_an_error(uci: Uci, path: str) -> None:
    done = uci.run("get", path)
    assert (done.returncode, done.stderr) == (1, "uci: Entry not found\n")
    assert uci.run("-q", "get", path).stderr == ""


def test_changes_are_staged_until_commit(uci: Uci) -> None:
    uci.out("set", "network.lan.ipaddr=10.0.0.1")
    uci.out("delete", "network.loopback.proto")
    uci.out("add_list", "network.@device[0].ports=bat0")
    assert (uci.config / "network").read_text() == NETWORK
    name = uci.out("-X", "show", "network.@device[0]").split("=")[0]
    assert uci.out("changes").splitlines() == [
        "network.lan.ipaddr='10.0.0.1'",
        "-network.loopback.proto",
        f"{name}.ports+='bat0'",
    ]
    assert uci.out("get", "network.lan.ipaddr") == "10.0.0.1\n"
    uci.out("commit", "network")
    assert uci.out("changes") == ""
    written = (uci.config / "network").read_text()
    assert written == NETWORK.replace("192.168.1.1", "10.0.0.1").replace("\toption proto 'static'\n", "").replace(
        "\tlist ports 'eth1'\n", "\tlist ports 'eth1'\n\tlist ports 'bat0'\n"
    )


def test_revert_forgets_changes_of_a_package_or_an_option(uci: Uci) -> None:
    uci.out("set", "network.lan.ipaddr=10.0.0.1")
    uci.out("set", "network.lan.netmask=255.0.0.0")
    uci.out("revert", "network.lan.ipaddr")
    assert uci.out("changes") == "network.lan.netmask='255.0.0.0'\n"
    uci.out("revert", "network")
    assert uci.out("changes") == ""


def test_add_prints_the_name_of_the_new_section(uci: Uci) -> None:
    name = uci.out("add", "network", "route").strip()
    assert name.startswith("cfg04")
    uci.out("set", f"network.{name}.target=10.1.0.0")
    assert "network.@route[0].target='10.1.0.0'" in uci.out("show", "network")


def test_rename_reorder_and_del_list(uci: Uci) -> None:
    uci.out("rename", "network.lan=home")
    uci.out("reorder", "network.home=0")
    uci.out("del_list", "network.@device[0].ports=eth0")
    lines = uci.out("show", "network").splitlines()
    assert lines[0] == "network.home=interface"
    assert "network.@device[0].ports='eth1'" in lines


def test_batch_changes_are_staged_until_committed(uci: Uci) -> None:
    uci.out("batch", stdin="set network.lan.ipaddr='10.0.0.7'\nset network.lan.note='two words'\n")
    assert "10.0.0.7" not in (uci.config / "network").read_text()
    uci.out("batch", stdin="commit network\n")
    assert "\toption note 'two words'\n" in (uci.config / "network").read_text()


def test_import_replaces_and_commits_at_once(uci: Uci) -> None:
    uci.out("import", "network", stdin="package network\n\nconfig interface 'wan'\n\toption proto 'dhcp'\n")
    assert uci.out("show", "network") == "network.wan=interface\nnetwork.wan.proto='dhcp'\n"
    assert (uci.config / "network").read_text() == "\nconfig interface 'wan'\n\toption proto 'dhcp'\n\n"


def test_export_prints_the_package_with_its_name(uci: Uci) -> None:
    assert uci.out("export", "network") == f"package network\n{NETWORK}"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("config interface 'lan\n\toption a 'b'\n", "unterminated"),
        ("option a 'b'\n", "before the first section"),
        ("config interface 'lan'\n\toption a\n", "too few arguments"),
        ("config interface 'lan'\n\tnonsense a b\n", "invalid command"),
        ("config interface 'lan'\n\toption a 'b\n", "unterminated"),
    ],
)
def test_a_file_that_is_not_uci_is_an_error(uci: Uci, text: str, reason: str) -> None:
    (uci.config / "broken").write_text(text, encoding="utf-8")
    done = uci.run("show", "broken")
    assert done.returncode == 1
    assert reason in done.stderr
    assert done.stderr.startswith("uci: Parse error")


@given(st.text(st.characters(min_codepoint=32, max_codepoint=126) | st.just("\t"), min_size=1, max_size=30))
def test_any_value_survives_set_commit_and_get(tmp_path_factory: pytest.TempPathFactory, value: str) -> None:
    uci = Uci(tmp_path_factory.mktemp("uci"))
    (uci.config / "system").write_text("config system 'main'\n", encoding="utf-8")
    uci.out("set", f"system.main.note={value}")
    uci.out("commit", "system")
    assert uci.out("get", "system.main.note") == f"{value}\n"


def test_json_text_survives_being_read_and_written(tmp_path: Path) -> None:
    text = 'it\'s "quoted", a\\b\\\\c & more\nof it'
    program = tmp_path / "echo.awk"
    program.write_text('{ json($0); print json_shown("") }', encoding="utf-8")
    command = [str(BUSYBOX), "awk", "-f", f"{STAND_INS}/lab/json.awk", "-f", str(program)]
    done = subprocess.run(command, input=json.dumps({"text": text}), capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == {"text": text}
