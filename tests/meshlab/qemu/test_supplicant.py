"""The configuration of the lab's wpa_supplicant: the configured cell, with nothing left for it to choose."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from meshlab import rootfs
from meshlab.qemu import initramfs

SCRIPT = Path(initramfs.__file__).with_name("node_root") / "lab" / "supplicant"
KEY = "a word that all of them know"


def config_of(mode: str, width: str = "HT20", key: str = KEY) -> tuple[list[str], dict[str, str]]:
    """The configuration's global lines, and its network's options."""
    bssid = "-" if mode == "mesh" else "02:ca:fe:00:00:21"
    radio = (
        "mesh0", "0", mode, "2437", width, "a crew", bssid, "12000", "24", "02:4d:00:00:00:10", "100", "1000", "US",
        "sae" if mode == "mesh" else "psk2", key, "0",
    )  # fmt: skip
    busybox = rootfs.find_program("busybox", "busybox-static")
    done = subprocess.run((busybox, "ash", SCRIPT, *radio), capture_output=True, text=True, check=True, timeout=60)
    head, _, body = done.stdout.partition("network={\n")
    options = dict(line.strip().split("=", 1) for line in body.removesuffix("}\n").splitlines())
    return head.splitlines(), options


def test_an_ad_hoc_network_uses_the_configured_bssid_and_frequency_without_scanning() -> None:
    head, options = config_of("adhoc")
    assert "ap_scan=2" in head
    assert options["bssid"] == "02:ca:fe:00:00:21"
    assert (options["frequency"], options["fixed_freq"], options["mode"]) == ("2437", "1", "1")
    assert (options["key_mgmt"], options["proto"], options["pairwise"], options["group"]) == (
        "WPA-PSK", "RSN", "CCMP", "CCMP",
    )  # fmt: skip
    assert (options["ssid"], options["psk"]) == ('"a crew"', f'"{KEY}"')


def test_mesh_mode_uses_sae_and_leaves_forwarding_to_batman_adv() -> None:
    head, options = config_of("mesh")
    assert "ap_scan=2" not in head
    assert (options["mode"], options["key_mgmt"], options["ieee80211w"]) == ("5", "SAE", "2")
    assert (options["sae_password"], options["mesh_fwding"]) == (f'"{KEY}"', "0")
    assert "bssid" not in options


def test_a_64_digit_hex_key_is_written_as_a_raw_psk() -> None:
    assert config_of("adhoc", key="0f" * 32)[1]["psk"] == "0f" * 32


@pytest.mark.parametrize(
    ("width", "off"), [("NOHT", {"disable_ht"}), ("HT20", {"disable_ht40"}), ("HT40+", set()), ("HT40", set())]
)
def test_the_supplicant_uses_the_configured_channel_width(width: str, off: set[str]) -> None:
    options = config_of("adhoc", width)[1]
    assert {name for name in ("disable_ht", "disable_ht40") if name in options} == off
