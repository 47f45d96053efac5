"""What a radio cannot do is refused before anything is sent: the device says it, not the inventory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from meshctl.device.observation import Observation, RadioChip
from meshctl.model import Fleet
from meshctl.plan import Verdict
from meshctl.plan.abilities import lacking_abilities
from meshctl.plan.observed_files import packages_seen
from tests.meshctl.plan.support import factory, fleet, planned, running, wanted

PATH = "platform/ahb/18100000.wmac"
ATH9K = RadioChip("phy0", PATH, "ath9k", ("IBSS", "managed", "AP", "mesh point"), (2412, 2437, 2462))
ATH10K = replace(ATH9K, driver="ath10k_pci", modes=("managed", "AP", "mesh point"))
AT_5_GHZ = replace(ATH9K, frequencies_mhz=(5180, 5825))


def with_chip(seen: Observation, chip: RadioChip) -> Observation:
    return replace(seen, chips=(chip,))


@pytest.mark.parametrize(
    ("chip", "reason"),
    [
        (ATH10K, "radio0 (ath10k_pci) has no ad-hoc mode: its driver supports managed, AP, mesh point"),
        (AT_5_GHZ, "radio0 (ath9k) does not work at 2.4 GHz: it has 5180 to 5825 MHz"),
        (replace(ATH9K, frequencies_mhz=(2412, 2462)), "radio0 (ath9k) has no channel 6"),
    ],
)
@pytest.mark.parametrize("observed", [running, factory])
def test_a_radio_that_cannot_do_what_it_gets_is_refused(
    chip: RadioChip, reason: str, observed: Callable[[Fleet, str], Observation]
) -> None:
    plan = planned(fleet(), "b01", with_chip(observed(fleet(), "b01"), chip))
    assert (plan.verdict, plan.reason) == (Verdict.REFUSED, reason)
    assert "ath10k-ct" in plan.hint


@pytest.mark.parametrize(
    "chip",
    [
        ATH9K,
        # the same driver with community firmware
        replace(ATH9K, driver="ath10k_pci"),
        # another radio of the board, which the inventory leaves alone
        replace(ATH10K, path="pci0000:00/0000:00:00.0"),
        RadioChip("phy0", PATH, "ath10k_pci"),
    ],
)
def test_a_radio_that_can_or_that_the_device_does_not_describe_is_planned(chip: RadioChip) -> None:
    assert planned(fleet(), "b01", with_chip(factory(fleet(), "b01"), chip)).verdict is Verdict.CHANGE


def test_without_a_path_in_the_inventory_the_radio_is_found_by_that_of_the_device() -> None:
    seen = with_chip(factory(fleet(), "b01"), ATH10K)
    team = fleet()
    node = team.nodes["b01"]
    radios = tuple(replace(radio, path="") for radio in node.hardware.radios)
    desired = next(file.package for file in wanted(team, "b01").files if file.path == "etc/config/wireless")
    before = packages_seen(["etc/config/wireless"], seen)["wireless"]
    without = replace(node, hardware=replace(node.hardware, radios=radios))
    assert lacking_abilities(without, seen, before, desired)
    assert not lacking_abilities(without, seen, None, desired)


def test_firmware_may_bring_another_driver_so_a_flash_is_planned_with_a_note() -> None:
    team = fleet(firmware='firmware: {image: image.bin, revision: r2, sha256: "' + "0" * 64 + '"}')
    plan = planned(team, "b01", with_chip(running(team, "b01"), ATH10K))
    assert plan.verdict is Verdict.CHANGE
    assert any("has no ad-hoc mode" in note and "another driver" in note for note in plan.notes)


def test_an_image_of_another_target_is_noted() -> None:
    seen = running(fleet(), "b01")
    assert seen.release is not None
    assert planned(fleet(), "b01", seen).notes == ()
    other = replace(seen, release=replace(seen.release, target="ramips/mt7621"))
    (note,) = planned(fleet(), "b01", other).notes
    assert note.startswith("it runs an image for ramips/mt7621, its profile says ath79/generic")
