"""A node that is fifteen times slower than the others: a busy 400 MHz processor whose flash is being formatted."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from meshctl.apply.health_checks import RELOADING
from tests.meshctl.proof.rig import Rig

pytestmark = [
    pytest.mark.proof,
    pytest.mark.lab,
    pytest.mark.xdist_group("rigs"),
    pytest.mark.timeout(1800),
]

SLOW = "n001"
# each reload of the firewall takes this node 15 to 21 s, its radio 9 to 22 s, and one change takes several of them
WINDOW_S = 240


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with Rig(tmp_path_factory.mktemp("slow"), 2, window_s=WINDOW_S, slowness={SLOW: 15}) as started:
        taken = started.take_in("a")
        assert (taken.code, set(taken.results.values())) == (0, {"done"}), taken.out + taken.err
        yield started


def test_a_change_of_wireless_firewall_and_dropbear_is_confirmed_on_a_slow_node(rig: Rig) -> None:
    text = rig.inventory("a").read_text(encoding="utf-8")
    extra = "extra_uci: {firewall.management.mtu_fix: '1', 'dropbear.@dropbear[0].IdleTimeout': '300'}"
    text = text.replace("defaults: {", f"defaults: {{{extra}, ")
    text = text.replace("distance_m: 1000", "distance_m: 1000\n    mcast_rate_kbps: 6000")
    rig.inventory("many").write_text(text, encoding="utf-8")
    ended = rig.meshctl("provision", "many", SLOW, "--yes", "--json")
    assert (ended.code, ended.results) == (0, {SLOW: "done"}), ended.out + ended.err
    options = ("firewall.management.mtu_fix", "dropbear.@dropbear[0].IdleTimeout", "wireless.mesh0.mcast_rate")
    shown = rig.fleet.node(SLOW).exec("; ".join(f"uci get {option}" for option in options)).stdout
    assert shown.split() == ["1", "300", "6000"]
    back = rig.meshctl("provision", "a", SLOW, "--yes", "--json")
    assert (back.code, back.results) == (0, {SLOW: "done"}), back.out + back.err


def test_a_window_that_is_too_short_for_a_slow_node_is_given_as_the_reason(rig: Rig) -> None:
    text = (
        rig.inventory("a").read_text(encoding="utf-8").replace(f"confirm_window_s: {WINDOW_S}", "confirm_window_s: 30")
    )
    text = text.replace("defaults: {", "defaults: {extra_uci: {firewall.management.mtu_fix: '1'}, ")
    rig.inventory("short").write_text(text.replace("distance_m: 1000", "distance_m: 2000"), encoding="utf-8")
    ended = rig.meshctl("provision", "short", SLOW, "--yes", "--json")
    assert ended.results == {SLOW: "rolled back"}, ended.out + ended.err
    (outcome,) = (event["outcome"] for event in ended.events if event["event"] == "finished")
    assert "had not reloaded within the confirm window" in outcome["reason"] or RELOADING in outcome["reason"]
    assert rig.meshctl("provision", "a", "--check", "--json").verdicts[SLOW] == "same"


def test_a_mesh_wide_change_waits_for_its_slow_member(rig: Rig) -> None:
    ended = rig.meshctl("provision", "split", "--yes", "--json")
    assert (ended.code, ended.results) == (0, dict.fromkeys(("base", *rig.names), "done")), ended.out + ended.err
    assert {rig.state_of(name, "a", "split") for name in ("base", *rig.names)} == {"new"}


def test_a_slow_node_that_a_change_cuts_off_returns_without_a_reboot(rig: Rig) -> None:
    boot = rig.fleet.node(SLOW).boot_id
    text = rig.inventory("split").read_text(encoding="utf-8")
    text = text.replace("defaults: {", "defaults: {extra_uci: {firewall.management.input: REJECT}, ")
    rig.inventory("locked").write_text(text, encoding="utf-8")
    ended = rig.meshctl("provision", "locked", SLOW, "--yes", "--json")
    assert ended.results == {SLOW: "rolled back"}, ended.out + ended.err
    assert rig.meshctl("provision", "split", "--check", "--json").verdicts[SLOW] == "same"
    assert rig.fleet.node(SLOW).boot_id == boot
