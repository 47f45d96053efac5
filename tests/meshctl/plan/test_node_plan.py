"""One node's plan: empty if the node is as desired, else the differences, or a failed precondition."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any

import pytest

from meshctl.device.observation import BoardInfo, ChangeStatus, ReleaseInfo
from meshctl.plan import Cut, Plan, Verdict, node_plan
from meshctl.plan.masking import Fingerprints
from meshctl.plan.packages import Needs
from meshctl.report.plan_text import plan_lines
from meshctl.uci import Section
from tests.meshctl.plan.support import FINGERPRINTS, PASS_PHRASE, factory, fleet, planned, running, wanted


def test_an_up_to_date_node_has_no_changes() -> None:
    plan = planned(fleet(), "b01", running(fleet(), "b01"))
    assert (plan.verdict, plan.files, plan.effects, plan.splits) == (Verdict.SAME, (), (), ())
    assert (plan.has_cell, plan.is_meshed) == (True, True)


def test_quoting_and_comments_are_not_a_difference() -> None:
    seen = running(fleet(), "b01")
    assert seen.uci is not None
    loose = {name: "# by hand\n" + text.replace("'", '"') + "\n\n" for name, text in seen.uci.items()}
    assert planned(fleet(), "b01", replace(seen, uci=loose)).verdict is Verdict.SAME


def test_a_factory_device_gets_all_files_and_loses_no_mesh_links() -> None:
    plan = planned(fleet(), "b01", factory(fleet(), "b01"))
    assert plan.verdict is Verdict.CHANGE
    assert {file.path for file in plan.files} == {file.path for file in wanted(fleet(), "b01").files}
    assert (plan.has_cell, plan.is_meshed, plan.splits) == (False, False, ())
    assert any("changes from 192.168.1.1 to 10.42.0.101" in effect.why for effect in plan.effects)


def test_a_channel_change_splits_the_node_from_its_mesh() -> None:
    plan = planned(fleet(channel=11), "b01", running(fleet(), "b01"))
    assert plan.splits == ("radio0: channel 6 -> 11",)
    assert plan.cut is Cut.MESH
    assert [file.path for file in plan.files] == ["etc/config/wireless", "etc/meshctl/node"]
    assert "-\toption channel '6'\n+\toption channel '11'" in plan.files[0].diff


def test_a_key_change_is_reported_without_showing_the_keys() -> None:
    seen = running(fleet(), "b01")
    assert seen.uci is not None
    old = {**seen.uci, "wireless": seen.uci["wireless"].replace(PASS_PHRASE, "the old pass phrase")}
    plan = planned(fleet(), "b01", replace(seen, uci=old))
    assert plan.splits == ("radio0: key changes",)
    assert "-\toption key '******** (another)'\n+\toption key '********'" in plan.files[0].diff
    assert PASS_PHRASE not in repr(plan)
    assert "the old pass phrase" not in repr(plan)


def test_a_hostname_change_interrupts_nothing() -> None:
    seen = running(fleet(), "b01")
    assert seen.uci is not None
    other = {**seen.uci, "system": seen.uci["system"].replace("b01", "OpenWrt")}
    plan = planned(fleet(), "b01", replace(seen, uci=other))
    assert ([file.path for file in plan.files], plan.cut) == (["etc/config/system"], Cut.NOTHING)


def test_a_changed_key_file_mode_is_a_difference() -> None:
    seen = running(fleet(), "b01")
    path = "/etc/dropbear/authorized_keys"
    info = seen.files[path]
    assert info is not None
    plan = planned(fleet(), "b01", replace(seen, files={**seen.files, path: replace(info, mode=0o644)}))
    assert [(file.path, file.diff) for file in plan.files] == [("etc/dropbear/authorized_keys", "mode 0644 -> 0600\n")]


def test_an_unparsable_uci_file_is_replaced_and_not_shown() -> None:
    seen = running(fleet(), "b01")
    assert seen.uci is not None
    plan = planned(fleet(), "b01", replace(seen, uci={**seen.uci, "wireless": "config wifi-device 'radio0"}))
    assert [file.path for file in plan.files] == ["etc/config/wireless"]
    assert "wifi-device" not in plan.files[0].diff


def test_an_unreachable_node_is_away_with_the_reason() -> None:
    plan = planned(fleet(), "b01", None, unreachable="no answer at 10.42.0.101")
    assert (plan.verdict, plan.reason) == (Verdict.AWAY, "no answer at 10.42.0.101")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"board": BoardInfo("ubnt,rocket-m")}, "wrong board: expected compex,wpj344-16m (box), found ubnt,rocket-m"),
        ({"board": None}, "cannot read its board"),
        ({"board": None, "root_read_only": True}, "its root file system is read-only: it is in failsafe mode"),
        ({"uci": None}, "cannot read its configuration"),
        (
            {"release": ReleaseInfo("OpenWrt", "21.02.7", "r1", "ath79/generic")},
            "its configuration is for OpenWrt 23.05, it runs 21.02.7",
        ),
        ({"macs": {"lan1": "02:00:00:00:00:10"}}, "it has no port eth0: found lan1"),
        ({"uci_changes": ("network.lan.ipaddr='1.2.3.4'",)}, "it has uncommitted UCI changes"),
        (
            {"unconfirmed_packages": ("network", "wireless")},
            "rpcd waits for the confirmation of a change to network, wireless (LuCI: Save & Apply)",
        ),
        ({"packages": {"dropbear": "1"}}, "it lacks batctl-default, iw, kmod-batman-adv"),
        (
            {"change": ChangeStatus("idle", lock_owner="bob@laptop:17:4711", lock_left_s=42.0)},
            "locked by bob@laptop (process 17) for 42 more seconds",
        ),
        ({"change": ChangeStatus("applied", owner="bob@laptop:1")}, "bob@laptop:1 has a change applied on it"),
    ],
)
def test_a_node_with_an_unmet_precondition_is_refused_with_the_reason(changes: dict[str, Any], reason: str) -> None:
    plan = planned(fleet(), "b01", running(fleet(), "b01", **changes), owner="alice@base:7")
    assert plan.verdict is Verdict.REFUSED
    assert plan.reason.startswith(reason)


def test_a_missing_switch_port_is_named_by_itself_and_not_by_its_vlan() -> None:
    team = fleet()
    b01 = replace(team.nodes["b01"], lan_ports=("eth0.1",))
    team = replace(team, nodes=MappingProxyType({**team.nodes, "b01": b01}))
    macs = {"eth1": "02:00:00:00:00:10", "eth0.1": "02:00:00:00:00:11"}
    plan = planned(team, "b01", running(team, "b01", macs=macs))
    assert plan.reason.startswith("it has no port eth0, on which eth0.1 is a VLAN: found eth0.1, eth1")


def test_a_radio_at_another_path_is_refused() -> None:
    seen = factory(fleet(), "b01")
    assert seen.uci is not None
    moved = {**seen.uci, "wireless": seen.uci["wireless"].replace("18100000", "18200000")}
    plan = planned(fleet(), "b01", replace(seen, uci=moved))
    assert "wrong device path of radio0: expected platform/ahb/18100000.wmac" in plan.reason


def test_a_lock_of_another_run_says_what_to_do() -> None:
    seen = running(fleet(), "b01", change=ChangeStatus("idle", lock_owner="bob@laptop:17:4711", lock_left_s=42.0))
    assert (
        planned(fleet(), "b01", seen, owner="alice@base:7").hint == "wait until the other run ends or its lock expires"
    )


def test_our_own_lock_does_not_block_the_plan() -> None:
    seen = running(fleet(), "b01", change=ChangeStatus("idle", lock_owner="alice@base:7", lock_left_s=42.0))
    assert planned(fleet(), "b01", seen, owner="alice@base:7").verdict is Verdict.SAME


def test_a_different_revision_is_flashed_if_the_inventory_names_an_image() -> None:
    team = fleet(firmware="firmware: {image: box.bin, revision: r24106}")
    plan = planned(team, "b01", running(team, "b01"))
    assert plan.firmware is not None
    assert (plan.firmware.from_revision, plan.firmware.to_revision) == ("r23809", "r24106")
    assert plan.cut is Cut.NODE
    assert planned(team, "b01", running(team, "b01"), with_firmware=False).firmware is None
    old = running(team, "b01", release=ReleaseInfo("OpenWrt", "21.02.7", "r1", "ath79/generic"))
    assert planned(team, "b01", old).verdict is Verdict.CHANGE


def test_a_fingerprint_depends_on_files_and_salt_but_not_on_order() -> None:
    one = Fingerprints(b"salt")
    assert one.of({"a": "1", "b": "2"}) == one.of({"b": "2", "a": "1"})
    assert one.of({"a": "1", "b": "2"}) != one.of({"a": "12", "b": ""})
    assert one.of({"a": "1"}) != Fingerprints(b"pepper").of({"a": "1"})
    assert one.of({"a": "key x"}, ["x"]) != one.of({"a": "key y"}, ["y"])


def test_a_factory_device_without_hostapd_common_is_planned_with_a_note() -> None:
    team = fleet()
    stock = factory(team, "b01")
    bare = {name: version for name, version in (stock.packages or {}).items() if name != "hostapd-common"}
    (note,) = planned(team, "b01", replace(stock, packages=bare)).notes
    assert note.startswith("it lacks hostapd-common: without its /usr/share/hostap/wdev.uc OpenWrt 23.05 brings up no")
    assert planned(team, "b01", replace(stock, packages=None)).notes == ()


def test_missing_packages_are_not_noted_on_a_node_in_its_mesh() -> None:
    team = fleet()
    seen = running(team, "b01")
    other = {name: text for name, text in (seen.uci or {}).items() if name != "firewall"}
    bare = {name: version for name, version in (seen.packages or {}).items() if name != "hostapd-common"}
    plan = planned(team, "b01", replace(seen, uci=other, packages=bare))
    assert (plan.verdict, plan.notes) == (Verdict.CHANGE, ())


def test_replacing_the_supplicant_cuts_the_mesh_although_no_file_changes() -> None:
    """`apply/packages.py` restarts all radios. Seen on real OpenWrt: planned as if it interrupted nothing."""
    team = fleet()
    seen = running(team, "b01")
    want = wanted(team, "b01")
    (full,) = (name for name in seen.packages or {} if name.startswith("wpad"))
    had = {name: version for name, version in (seen.packages or {}).items() if name != full}
    given = replace(want, package_files=(f"{full}_1_mips.ipk",))

    def effects_with(old: str) -> dict[str, Cut]:
        plan = node_plan(given, replace(seen, packages=had | {old: "1"}), FINGERPRINTS, owner="", with_firmware=False)
        assert (plan.verdict, plan.files) == (Verdict.CHANGE, ())
        return {effect.why: effect.cut for effect in plan.effects}

    assert effects_with("wpad-basic-mbedtls") == {
        "all radios restart, because wpad-basic-mbedtls is replaced": Cut.MESH
    }
    assert effects_with("nano") == {}


@pytest.mark.parametrize(
    ("new", "is_open", "refused"),
    [("wpad-basic-mbedtls", False, True), ("wpad-openssl", False, False), ("wpad-basic-mbedtls", True, False)],
)
def test_the_supplicant_of_a_mesh_that_is_still_encrypted_is_not_removed(
    new: str, is_open: bool, refused: bool
) -> None:
    """Packages come before files: it left the mesh, and rolled back at the end of its window."""
    seen = running(fleet(), "b01")
    assert seen.uci is not None
    if is_open:
        wireless = seen.uci["wireless"].replace("option encryption 'psk2+ccmp'", "option encryption 'none'")
        seen = replace(seen, uci={**seen.uci, "wireless": wireless})
    (full,) = (name for name in seen.packages or {} if name.startswith("wpad"))
    want = replace(wanted(fleet(), "b01"), needs=Needs(((new,),), (full,)), package_files=(f"{new}_1_mips.ipk",))
    plan = node_plan(want, seen, FINGERPRINTS, owner="", with_firmware=False)
    if refused:
        assert plan.verdict is Verdict.REFUSED
        assert plan.reason == f"{full} would be removed while mesh0 is encrypted, and the node would leave its mesh"
    else:
        assert plan.packages is not None
        assert plan.packages.remove == (full,)


def test_an_untagged_port_to_a_vlan_switch_is_planned_with_a_note() -> None:
    team = fleet()
    seen = factory(team, "b01")
    behind = replace(seen, board=BoardInfo("compex,wpj344-16m", lan_ports=("eth0.1",)))
    want = wanted(team, "b01")
    kept = tuple(
        replace(file, package=replace(file.package, sections=(*file.package.sections, Section("switch_vlan"))))
        if file.package is not None and file.package.name == "network"
        else file
        for file in want.files
    )
    (note,) = node_plan(replace(want, files=kept), behind, FINGERPRINTS).notes
    assert note.startswith("eth0 connects to a switch whose LAN is eth0.1")
    assert node_plan(want, behind, FINGERPRINTS).notes == ()
    assert node_plan(replace(want, files=kept), seen, FINGERPRINTS).notes == ()


@pytest.mark.parametrize(("option", "value"), [("rts", "500"), ("frag", "1000")])
def test_a_removed_threshold_is_noted_because_the_driver_keeps_it(option: str, value: str) -> None:
    seen = running(fleet(), "b01")
    assert seen.uci is not None
    wireless = seen.uci["wireless"].replace(
        "config wifi-device 'radio0'\n", f"config wifi-device 'radio0'\n\toption {option} '{value}'\n"
    )
    plan = planned(fleet(), "b01", replace(seen, uci={**seen.uci, "wireless": wireless}))
    assert plan.verdict is Verdict.CHANGE
    assert f"radio0: {option} {value} is removed, but stays in force until the node reboots" in plan.notes
    assert not any("stays in force" in note for note in planned(fleet(), "b01", seen).notes)


@pytest.mark.parametrize(
    ("installed", "file", "noted"),
    [
        ("2024.3-r1", "batctl-default_2024.3-r2_mips_24kc.ipk", "2024.3-r2"),
        ("2024.3-r2", "batctl-default_2024.3-r2_mips_24kc.ipk", ""),
        ("1:2024.3-r2", "batctl-default_2024.3-r2_mips_24kc.ipk", ""),
        ("2024.3-r1", "batctl-default-2024.3-r2.apk", "2024.3-r2"),
        ("2024.3-r2", "batctl-default-2024.3-r2.apk", ""),
        ("2024.3-r1", "other_2024.3-r2_all.ipk", ""),
    ],
)
def test_a_package_file_of_another_version_than_that_installed_is_noted_as_left_out(
    installed: str, file: str, noted: str
) -> None:
    team = fleet()
    desired = replace(wanted(team, "b01"), package_files=(f"packages/{file}",))
    seen = running(team, "b01")
    seen = replace(seen, packages={**(seen.packages or {}), "batctl-default": installed})
    plan = node_plan(desired, seen, FINGERPRINTS)
    assert plan.verdict is Verdict.SAME
    assert [note.partition(":")[0] for note in plan.notes] == (
        [f"batctl-default is installed as {installed}, package_files has {noted}"] if noted else []
    )
    text = "\n".join(
        line.text for line in plan_lines(Plan("team", 0.0, (), {"b01": plan}), with_diffs=False, width=200)
    )
    assert ("b01  up to date" in text) == bool(noted)
