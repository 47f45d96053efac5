"""Pure functions: specs, addresses, faults, images, and hiding applets of busybox."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from meshctl.errors import InputError
from meshctl.firmware.metadata import read_metadata
from meshctl.inventory import load_fleet
from meshctl.model import Release
from meshctl.resources import shipped
from meshlab import addresses, faults, from_inventory, releases, rootfs
from meshlab.cli import commands
from meshlab.errors import LabError
from meshlab.faults import Fault, FaultRequest
from meshlab.images import firmware_image
from meshlab.spec import FleetSpec, LinkSpec, Medium, NodeSpec, RadioSpec, dump, load


def test_a_fleet_spec_round_trips_through_dump_and_load() -> None:
    spec = FleetSpec(
        "x",
        (
            NodeSpec("a", medium=Medium.BASE, release=Release.V19_07, host_key_types=("rsa",)),
            NodeSpec("b", radios=(RadioSpec("radio0"), RadioSpec("radio1", band="5g", mac="02:00:00:00:00:09"))),
        ),
        (LinkSpec("a", "b", loss=0.5, rate_kbps=64, up=False),),
        port=20100,
    )
    assert load(dump(spec)) == spec


def test_an_invalid_fleet_spec_is_rejected_with_the_reason() -> None:
    with pytest.raises(InputError, match="twice: a"):
        FleetSpec("x", (NodeSpec("a"), NodeSpec("a")))
    with pytest.raises(InputError, match="link a-c: no node named c"):
        FleetSpec("x", (NodeSpec("a"),), (LinkSpec("a", "c"),))


def test_every_node_address_maps_to_a_unique_loopback_address() -> None:
    assert addresses.loopback_of("10.42.0.11") == "127.42.0.11"
    assert addresses.bench_of(0) == "127.255.0.1"
    assert addresses.bench_of(299) == "127.255.1.44"
    assert len({addresses.bench_of(number) for number in range(1000)}) == 1000


def test_default_links_keep_every_node_of_a_large_fleet_within_six_hops() -> None:
    names = [f"n{number}" for number in range(200)]
    parents = {link.b: link.a for link in from_inventory.default_links(names) if link.tq > 200}

    def hops(name: str) -> int:
        return 0 if name == "n0" else 1 + hops(parents[name])

    assert max(map(hops, names)) <= 6


def test_default_links_connect_the_nodes_of_each_mesh_without_those_of_another() -> None:
    names = ["base", "a1", "a2", "b1", "b2"]
    meshes = [["base", "a1", "a2"], ["base", "b1", "b2"]]
    ends = {link.ends for link in from_inventory.default_links(names, meshes) if link.tq > 200}
    assert {frozenset(("base", "b1")), frozenset(("b1", "b2")), frozenset(("base", "a1"))} <= ends
    assert from_inventory.default_links(names, [names]) == from_inventory.default_links(names)


def test_faults_are_parsed_and_described_with_an_optional_step() -> None:
    assert faults.parse("power-cut@7") == FaultRequest(Fault.CUT, "7")
    assert faults.parse("full-flash") == FaultRequest(Fault.FULL_FLASH)
    assert faults.describe(FaultRequest(Fault.FULL_FLASH)) == "only 8 KiB left in flash"
    assert faults.describe(FaultRequest(Fault.CUT, "7")).endswith("unsynced data is lost; at command 7 from now on")
    assert faults.describe(FaultRequest(Fault.SEVER, "uci commit")).endswith(
        "before the first command that contains 'uci commit'"
    )
    assert set(faults.FAULTS) == set(Fault)
    with pytest.raises(InputError, match="explode"):
        faults.parse("explode")
    with pytest.raises(InputError, match="takes no @STEP"):
        faults.parse("clock@3")


@pytest.mark.parametrize("release", list(Release))
def test_a_generated_image_has_readable_sysupgrade_metadata(release: Release) -> None:
    metadata = read_metadata(firmware_image(release, board="ubnt,rocket-m"))
    assert metadata is not None
    assert metadata.boards == ("ubnt,rocket-m",)
    assert releases.facts(release).revision == metadata.revision


@pytest.mark.parametrize(("options", "target"), [((), "ath79/generic"), (("--target", "ath79/nand"), "ath79/nand")])
def test_an_image_is_for_the_target_of_its_profile(options: tuple[str, ...], target: str, tmp_path: Path) -> None:
    file = tmp_path / "new.bin"
    done = CliRunner().invoke(commands.app, ["image", "23.05", "glinet,gl-ar750s-nor-nand", str(file), *options])
    assert done.exit_code == 0, done.output
    metadata = read_metadata(file.read_bytes())
    assert metadata is not None
    assert metadata.target == target


def test_an_image_contains_exactly_one_wpad_package() -> None:
    with_full = releases.image_packages(Release.V23_05, ("wpad-openssl",))
    assert [name for name in with_full if name.startswith("wpad")] == ["wpad-openssl"]
    plain = releases.image_packages(Release.V23_05, ())
    assert [name for name in plain if name.startswith("wpad")] == ["wpad-basic-mbedtls"]


names_of_applets = st.lists(st.text("abcdefghs12[", min_size=2, max_size=6), min_size=4, max_size=30, unique=True).map(
    lambda found: sorted({*found, "ash", "sh"})
)


@given(names_of_applets)
def test_hiding_applets_preserves_the_sort_order_of_the_table(names: list[str]) -> None:
    table = "\0".join(names).encode() + b"\0"
    image = b"before" + table + b"after"
    changed = rootfs.without_applets(image, names, set(names) - {"ash", "sh"}, keep=("ash", "sh"))
    assert len(changed) == len(image)
    found = changed[6:-5].split(b"\0")[:-1]
    for kept in (b"ash", b"sh"):
        place = names.index(kept.decode())
        assert found[place] == kept
        assert all(other < kept for other in found[:place])
        assert all(other > kept for other in found[place + 1 :])


def test_a_busybox_without_the_expected_applet_table_is_rejected() -> None:
    with pytest.raises(LabError, match="applet names"):
        rootfs.without_applets(b"nothing here", ["ash", "cat"], {"cat"}, keep=("ash",))


@pytest.mark.parametrize(
    ("words", "sent"),
    [((), ""), (("ps | wc -l",), "ps | wc -l"), (("sh", "-c", "echo a; echo b"), "sh -c 'echo a; echo b'")],
)
def test_the_console_quotes_a_command_as_run_does(
    words: tuple[str, ...], sent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_shell = mock.Mock(return_value=0)
    monkeypatch.setattr("meshlab.cli.commands.run_shell", run_shell)
    monkeypatch.setattr("meshlab.cli.commands.VirtualFleet", mock.MagicMock())
    done = CliRunner().invoke(commands.app, ["shell", "b01", *(("--", *words) if words else ())])
    assert (done.exit_code, run_shell.call_args.args[2]) == (0, sent)


@pytest.mark.parametrize(("name", "is_routed"), [("lab", True), ("mine", False)])
def test_nodes_that_the_lab_cannot_route_are_left_plugged_in(name: str, *, is_routed: bool) -> None:
    text = "\n".join(commands.next_steps(load_fleet(shipped("inventory") / name, environ={})))
    assert ("meshctl lab unplug" in text) == is_routed
    assert ("no node of mesh drift is reached" in text) != is_routed


@pytest.mark.parametrize(("channel", "is_noted"), [(36, False), (100, True), (149, False)])
def test_a_mesh_that_waits_for_radar_is_noted_for_the_real_lab(channel: int, is_noted: bool, tmp_path: Path) -> None:
    text = (shipped("inventory") / "swarm" / "fleet.yaml").read_bytes().decode("utf-8")
    (tmp_path / "fleet.yaml").write_text(text.replace("channel: 149", f"channel: {channel}"), encoding="utf-8")
    notes = commands.radar_notes(load_fleet(tmp_path, environ={}))
    assert [f"mesh air will not form on channel {channel}" in note for note in notes] == [True] * is_noted
