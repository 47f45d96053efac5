"""Devices that meshctl did not configure: what is kept, what is named, and that no secret is shown."""

from __future__ import annotations

import json
import shutil
import stat
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from meshctl.cli.main import build
from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.interchange.device import ExistingDevice, exported_device, observed_device, release_of
from meshctl.interchange.device_differences import Fate, compare
from meshctl.interchange.interfaces import bridge_ports
from meshctl.interchange.new_inventory import load_text, new_text
from meshctl.inventory import load_fleet
from meshctl.inventory.all_or_none import NewFiles
from meshctl.model import MASK, Encryption, Fleet, MeshMode, Release
from meshctl.render import render_node
from meshctl.render.compare import placeholder_secret
from meshctl.resources import shipped
from meshctl.uci import Package, Section
from tests.meshctl.device.test_observe import RECORDED, observed
from tests.meshctl.interchange.devices import SSH_KEY, exported, new_inventory

EXPORTS = Path(__file__).parent / "exports"
SECRETS = ("a very secret mesh key", "guests-password")
BOARD = ("--release", "24.10", "--board", "ubnt,rocket-m", "--target", "ath79/generic")


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    return Path(shutil.copytree(shipped("inventory") / "subt-final", tmp_path / "fleet"))


def run(*words: str) -> Result:
    return CliRunner().invoke(build("inventory"), ["inventory", "import", *words])


def test_a_foreign_mesh_becomes_an_entry_with_its_options_in_extra_uci(tmp_path: Path) -> None:
    made = new_inventory(exported("foreign"), tmp_path / "fleet")
    mesh = made.fleet.meshes["valley"]
    assert (mesh.mode, mesh.encryption, mesh.channel, mesh.mtu) == (MeshMode.MESH, Encryption.SAE, 6, 1536)
    # what batman-adv does without the option
    assert mesh.batman.distributed_arp_table
    assert made.kept == {
        "network.br_lan.igmp_snooping": "1",
        "network.lan.dns": "10.42.0.1 10.42.0.2",
        "network.bat0.ap_isolation": "1",
        "system.@system[0].cronloglevel": "5",
        "wireless.radio0.rts": "500",
        "wireless.mesh0.mesh_rssi_threshold": "-80",
    }
    assert dict(made.fleet.nodes["Roof-West"].extra_uci) == made.kept
    removed = {each.key: each.reason for each in made.of(Fate.REMOVED)}
    assert removed == {
        "firewall.@rule[0]": "",
        "network.globals": "--keep network.globals keeps it",
        "network.lan.ip6assign": "OpenWrt's default",
        "network.wan": "--keep network.wan keeps it",
        "system.@system[0].urandom_seed": "OpenWrt's default",
        "wireless.radio0.cell_density": "OpenWrt's default",
        "wireless.guests": "its key is a secret, which extra_uci cannot hold",
    }
    assert [each.line for each in made.of(Fate.CHANGED)] == [
        "system.@system[0].hostname: Roof West -> Roof-West",
        "wireless.mesh0.network: meshif -> mesh0",
    ]
    assert made.untouched == ("uhttpd",)


def test_every_option_of_a_device_is_in_the_entry_or_named(tmp_path: Path) -> None:
    for name in ("foreign", "stock-24.10", "stock-19.07", "switch-19.07", "vlans-24.10"):
        device = exported(name, release=Release.V19_07 if "19.07" in name else Release.V24_10)
        made = new_inventory(device, tmp_path, name="node", country="US")
        lines = "\n".join(
            [*(f"{key}: {value}" for key, value in made.kept.items()), *(d.line for d in made.differences)]
        )
        keys = [key.reveal() for key in made.secrets.values()]
        for package in device.packages.values():
            for section in package.sections if package.name not in made.untouched else ():
                for option, value in section.options.items():
                    text = value if isinstance(value, str) else " ".join(value)
                    shown = MASK if option == "key" else text
                    is_named = f".{option}: {shown}" in lines or f"{option}={shown}" in lines
                    is_same = text in keys or is_rendered(made.fleet, made.name, device, package.name, option, text)
                    assert is_named or is_same, (package.name, option)


def is_rendered(fleet: Fleet, node: str, device: ExistingDevice, package: str, option: str, text: str) -> bool:
    tree = render_node(fleet, node, placeholder_secret, device_facts=device.facts).package(package)
    assert tree is not None
    return any(section.get(option) == text for section in tree.sections)


def test_a_whole_section_is_kept_on_request_but_never_its_secret(tmp_path: Path) -> None:
    made = new_inventory(exported("foreign"), tmp_path, keep=("network.wan*", "wireless.*", "firewall.*"))
    assert {key: value for key, value in made.kept.items() if key.startswith("network.wan")} == {
        "network.wan": "interface",
        "network.wan.device": "eth1",
        "network.wan.proto": "dhcp",
    }
    reasons = {each.key: each.reason for each in made.of(Fate.REMOVED)}
    assert reasons["wireless.guests"] == "its key is a secret, which extra_uci cannot hold"
    assert reasons["firewall.@rule[0]"] == "extra_uci cannot hold an anonymous section"


@pytest.mark.parametrize("release", ["24.10", "19.07"])
def test_a_stock_device_gives_a_usable_entry(release: str, tmp_path: Path) -> None:
    made = new_inventory(exported(f"stock-{release}", release=release_of(release)), tmp_path, country="US")
    node = made.fleet.nodes["OpenWrt"]
    assert str(node.address) == "192.168.1.1/24"
    assert [radio.mesh for radio in node.radios] == [None]
    assert node.release is release_of(release)
    assert node.lan_ports == (("eth0.1",) if release == "19.07" else ("eth0",))
    assert node.hardware.switch_vlans == ((("1", "3 0t"),) if release == "19.07" else ())
    assert "wireless.default_radio0" in {each.key for each in made.of(Fate.REMOVED)}
    assert "operators.password_login: true" in made.assumed[0]


def test_a_board_with_a_switch_and_two_radios_keeps_its_vlans_and_meshes(tmp_path: Path) -> None:
    made = new_inventory(exported("switch-19.07", release=Release.V19_07), tmp_path)
    (node,) = made.fleet.nodes.values()
    assert node.lan_ports == ("eth1.1",)
    assert node.hardware.switch_vlans == (("1", "2 3 4 5 0t"), ("2", "1 6t"))
    assert [(radio.name, radio.mesh) for radio in node.radios] == [("radio0", "attic5"), ("radio1", "attic24")]
    meshes = made.fleet.meshes
    assert (meshes["attic5"].mode, meshes["attic24"].mode) == (MeshMode.MESH, MeshMode.ADHOC)
    assert (meshes["attic5"].channel, meshes["attic24"].bssid) == (48, "02:ca:ff:ee:ba:be")
    removed = {each.key for each in made.of(Fate.REMOVED)}
    assert {"network.wan", "network.wan6", "wireless.ap24", "firewall.@include[0]"} <= removed


def test_the_ports_of_a_bridges_vlan_are_those_of_the_node(tmp_path: Path) -> None:
    made = new_inventory(exported("vlans-24.10"), tmp_path)
    (node,) = made.fleet.nodes.values()
    # not `br-lan.1`, the VLAN's interface
    assert node.lan_ports == ("lan1", "lan2")
    assert [(radio.name, radio.mesh) for radio in node.radios] == [("radio0", "hall"), ("radio1", "hall-2")]
    assert len(made.secrets) == 2
    assert [each.line for each in made.of(Fate.CHANGED) if each.key.startswith("network.")] == [
        "network.br_lan.ports: lan1 lan2 lan3 bat0 -> lan1 lan2 bat0",
        "network.lan.device: br-lan.1 -> br-lan",
    ]
    assert {"network.@bridge-vlan[0]", "network.@bridge-vlan[1]", "network.cameras"} <= {
        each.key for each in made.of(Fate.REMOVED)
    }


def test_a_tagged_port_of_a_bridges_vlan_is_an_interface_of_that_vlan() -> None:
    bridge = Section("bridge-vlan", None, {"device": "br-lan", "vlan": "20", "ports": ("lan1:u*", "lan2", "lan3:t")})
    lan = Section("interface", "lan", {"device": "br-lan.20"})
    assert bridge_ports(Package("network", (bridge, lan)), lan) == ("lan1", "lan2", "lan3.20")


def test_a_stock_device_joins_the_mesh_of_an_inventory(fleet: Path) -> None:
    done = run(
        "uci", str(EXPORTS / "stock-24.10.uci"), "-i", str(fleet), "--hardware", "rocket", "--name", "new",
        "--address", "10.42.0.77", "--role", "robot", "--label", "N1",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    node = load_fleet(fleet).nodes["new"]
    assert (node.meshes, node.role.value, node.label) == (("main",), "robot", "N1")
    assert str(node.address) == "10.42.0.77/24"
    assert "network.lan.ipaddr: 192.168.1.1 -> 10.42.0.77" in done.output
    assert "wireless.mesh0: wifi-iface" in done.output
    before = (shipped("inventory") / "subt-final" / "fleet.yaml").read_text(encoding="utf-8")
    after = (fleet / "fleet.yaml").read_text(encoding="utf-8")
    assert [line for line in after.splitlines() if line not in before.splitlines()] == [
        next(line for line in after.splitlines() if "new:" in line)
    ]


def test_a_new_inventory_is_written_with_the_key_in_a_private_file(tmp_path: Path) -> None:
    words = ("uci", str(EXPORTS / "foreign.uci"), "--new", str(tmp_path / "valley"), *BOARD)
    dry = run(*words, "--dry-run")
    assert dry.exit_code == 0, dry.output
    assert list(tmp_path.iterdir()) == []
    done = run(*words)
    assert done.exit_code == 0, done.output
    key = tmp_path / "valley-valley.key"
    assert key.read_text() == "a very secret mesh key\n"
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    text = (tmp_path / "valley" / "fleet.yaml").read_text(encoding="utf-8")
    for secret in SECRETS:
        assert secret not in text + done.output + dry.output
    made = load_fleet(tmp_path / "valley")
    assert made.nodes["Roof-West"].meshes == ("valley",)
    again = run(*words)
    assert again.exit_code == 2
    assert "already exists; not overwritten" in again.output


def test_an_existing_key_file_is_not_overwritten_and_nothing_else_is_written(tmp_path: Path) -> None:
    (tmp_path / "valley-valley.key").write_text("mine\n")
    done = run("uci", str(EXPORTS / "foreign.uci"), "--new", str(tmp_path / "valley"), *BOARD)
    assert done.exit_code == 2
    assert "valley-valley.key already exists" in done.output
    assert (tmp_path / "valley-valley.key").read_text() == "mine\n"
    assert not (tmp_path / "valley").exists()


def test_json_has_the_entry_and_every_difference(fleet: Path) -> None:
    done = run("uci", str(EXPORTS / "foreign.uci"), "-i", str(fleet), "--hardware", "rocket", "--dry-run", "--json")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["node"] == "Roof-West"
    assert found["written"] is False
    assert found["entries"]["nodes.Roof-West"]["extra_uci"]["wireless.radio0.rts"] == "500"
    assert {"fate", "key", "device", "rendered", "reason"} == set(found["differences"][0])
    assert found["untouched"] == ["uhttpd"]
    assert not any(secret in done.stdout for secret in SECRETS)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nowhere.uci", "--hardware", "rocket"), "cannot be read"),
        (("foreign.uci",), "expected --release and --board"),
        (("foreign.uci", "--hardware", "rokcet"), "no hardware profile 'rokcet': expected one of rocket"),
        (("foreign.uci", "--release", "18.06", "--board", "x"), "expected a release of 19.07"),
        (("foreign.uci", "--hardware", "rocket", "--name", "base"), "already has a node 'base'"),
        (("foreign.uci", "--hardware", "rocket", "--address", "here"), "expected an IP address"),
        (("foreign.uci", "--hardware", "rocket", "--state", "lost"), "neither lost nor retired"),
        (("foreign.uci", "--hardware", "rocket", "--group", "nosuch"), "nosuch"),
        (("README.md", "--hardware", "rocket"), "README.md:3:1: expected package, config, option or list"),
    ],
)
def test_wrong_input_changes_nothing(words: tuple[str, ...], message: str, fleet: Path) -> None:
    before = (fleet / "fleet.yaml").read_bytes()
    done = run("uci", str(EXPORTS / words[0]), *words[1:], "-i", str(fleet))
    assert done.exit_code == 2, done.output
    assert message in done.output
    assert (fleet / "fleet.yaml").read_bytes() == before


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("network.lan=interface\nnetwork.lan.proto='static'\n", "this is the output of `uci show`"),
        ("wireless.@wifi-iface[0]=wifi-iface\n", "this is the output of `uci show`"),
        ("\nconfig interface 'lan'\n\toption proto 'static'\n", "does not name its package"),
        ("package network\n\nconfig interface 'lan'\n\toption\n", ""),
    ],
)
def test_a_file_that_is_no_uci_export_says_how_to_record_one(text: str, hint: str) -> None:
    with pytest.raises(InvalidInput) as refused:
        exported_device(text, "roof.uci", release=Release.V24_10, board="x", target="")
    (found,) = refused.value.diagnostics
    assert hint in found.hint
    assert bool(found.hint) == bool(hint)


def test_a_device_without_a_country_or_a_static_address_says_which_option_helps(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no radio of the device has a country"):
        new_inventory(exported("stock-24.10"), tmp_path)
    device = exported("foreign")
    network = device.package("network")
    dhcp = tuple(
        Section(each.type, each.name, {"proto": "dhcp", "device": "br-lan"}) if each.name == "lan" else each
        for each in network.sections
    )
    dynamic = type(device)({**device.packages, "network": Package("network", dhcp)}, device.release, device.board)
    with pytest.raises(InputError, match="no static address") as raised:
        new_inventory(dynamic, tmp_path)
    assert "--address" in raised.value.hint


@pytest.mark.parametrize("release", ["19.07", "21.02", "22.03", "23.05", "24.10", "25.12"])
def test_a_recorded_observation_of_every_release_is_imported(release: str, tmp_path: Path) -> None:
    device = observed_device(observed(RECORDED / release / "mesh"))
    made = new_inventory(device, tmp_path, country="US")
    node = made.fleet.nodes[device.hostname]
    assert node.release.value == release
    assert node.hardware.board == device.board
    assert made.fleet.operators.ssh_keys == device.authorized_keys
    assert str(node.address.ip).startswith("10.42.0.")


def test_a_file_that_is_not_uci_is_listed_and_the_rest_imported(tmp_path: Path) -> None:
    seen = observed(RECORDED / "24.10" / "mesh")
    broken = {"broken": "config thing 'x'\n\toption bad 'un'closed'\n", "notes": "bought in May\n"}
    device = observed_device(replace(seen, uci={**(seen.uci or {}), **broken}))
    made = new_inventory(device, tmp_path, country="US")
    assert [line.partition(":")[0] for line in made.unreadable] == ["/etc/config/broken", "/etc/config/notes"]
    assert made.differences == new_inventory(observed_device(seen), tmp_path, country="US").differences


@pytest.mark.parametrize("package", ["network", "firewall"])
def test_a_file_that_meshctl_writes_must_be_uci(package: str, tmp_path: Path) -> None:
    seen = observed(RECORDED / "24.10" / "mesh")
    with pytest.raises(InvalidInput, match=f"/etc/config/{package}:1:1: .*expected"):
        new_inventory(
            observed_device(replace(seen, uci={**(seen.uci or {}), package: "no section\n"})), tmp_path, country="US"
        )


def test_the_key_of_a_collector_is_no_operators(tmp_path: Path) -> None:
    device = observed_device(observed(RECORDED / "24.10" / "mesh"))
    (operator, *_) = device.authorized_keys
    collector = f'command="sh /etc/meshctl/links.sh",no-pty {operator.rsplit(" ", 1)[0]} collector of husky1'
    made = new_inventory(replace(device, authorized_keys=(operator, collector)), tmp_path, country="US")
    assert made.fleet.operators.ssh_keys == (operator,)


def test_lists_are_kept_only_where_a_text_of_words_means_the_same() -> None:
    own = Package("firewall", (Section("defaults", None, {"helpers": ("a", "b")}),))
    target = Package("firewall", (Section("defaults", None, {"input": "REJECT"}),))
    found = compare({"firewall": own}, {"firewall": target}, {})
    assert found.extra_uci == {}
    assert [each.reason for each in found.differences] == ["a list, which extra_uci cannot hold", ""]


def test_the_operators_own_key_logs_in_to_a_device_without_one(tmp_path: Path) -> None:
    made = new_inventory(exported("foreign"), tmp_path, operator_key=SSH_KEY)
    assert made.fleet.operators.ssh_keys == (SSH_KEY,)
    assert not made.fleet.operators.password_login


def test_a_line_break_in_the_boards_name_cannot_add_to_the_inventory(tmp_path: Path) -> None:
    device = replace(exported("foreign"), board="evil,box\nnodes: {evil: {}}")
    made = new_inventory(device, tmp_path)
    text = new_text(made.values, "a device\nrobots: {}", made.assumed)
    assert list(load_text(tmp_path / "fleet.yaml", text).nodes) == ["Roof-West"]


def test_a_failed_write_leaves_no_key_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create = NewFiles.create

    def fail(self: NewFiles, path: Path, content: bytes, *, mode: int = 0o666) -> None:
        if path.name == "fleet.yaml":
            create(self, path, content[:100], mode=mode)
            raise KeyboardInterrupt
        create(self, path, content, mode=mode)

    monkeypatch.setattr(NewFiles, "create", fail)
    done = run("uci", str(EXPORTS / "foreign.uci"), "--new", str(tmp_path / "valley"), *BOARD)
    assert done.exit_code == 130
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_what_lint_will_call_an_error_is_listed_with_what_to_do(tmp_path: Path) -> None:
    """A radar channel, an MTU beyond a frame, and no base: the device has them, and meshctl would refuse them."""
    text = (EXPORTS / "foreign.uci").read_text(encoding="utf-8")
    changed = (
        ("option band '2g'", "option band '5g'"), ("option channel '6'", "option channel '52'"),
        ("option mtu '1536'", "option mtu '2304'"),
    )  # fmt: skip
    for old, new in changed:
        assert old in text
        text = text.replace(old, new, 1)
    (tmp_path / "dfs.uci").write_text(text, encoding="utf-8")
    words = ("uci", str(tmp_path / "dfs.uci"), "--new", str(tmp_path / "valley"), *BOARD)
    done = run(*words, "--dry-run", "--json")
    assert done.exit_code == 0, done.output
    errors = {each["code"]: each for each in json.loads(done.output)["lint_errors"]}
    assert set(errors) == {"MC507", "MC602", "MC620"}
    assert errors["MC507"]["path"] == "meshes.valley.mtu"
    assert "`confirm_window_s` to 200" in errors["MC620"]["hint"]
    shown = run(*words).output
    assert "to be set before provisioning:\n  meshes.valley.mtu: exceeds an 802.11 frame" in shown
    assert "[MC602]. Set `role: base` on the operator's radio" in shown
    # the next node repeats none of them
    second = run("uci", str(tmp_path / "dfs.uci"), "-i", str(tmp_path / "valley"), "--name", "near",
                 "--address", "10.42.0.78/24", *BOARD, "--dry-run", "--json")  # fmt: skip
    assert second.exit_code == 0, second.output
    assert "MC620" not in {each["code"] for each in json.loads(second.output)["lint_errors"]}
