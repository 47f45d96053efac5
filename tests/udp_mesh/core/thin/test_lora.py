"""Airtime of Meshtastic's presets: the line against Semtech's formula, the presets against Meshtastic's own library."""

from __future__ import annotations

from math import ceil

import pytest
from meshtastic.protobuf import config_pb2, mesh_pb2

from udp_mesh.core.thin.lora import MESHTASTIC_OVERHEAD_BYTES, PREAMBLE_SYMBOLS, PRESETS, LoraPreset
from udp_mesh.links.meshtastic_port import MAX_PAYLOAD_BYTES


def semtech_s(preset: LoraPreset, size: int) -> float:
    """AN1200.13: explicit header (IH 0), CRC, DE where a symbol takes 16 ms."""
    low_rate = 2.0**preset.spreading / preset.bandwidth_hz >= 0.016
    bits = 8 * size - 4 * preset.spreading + 28 + 16
    groups = max(0, ceil(bits / (4 * (preset.spreading - 2 * low_rate))))
    return preset.symbol_s * (PREAMBLE_SYMBOLS + 8 + groups * preset.coding)


@pytest.mark.parametrize("name", PRESETS)
def test_the_line_is_at_most_one_group_above_the_airtime(name: str) -> None:
    preset = PRESETS[name]
    for size in range(1, 256):
        excess_s = preset.frame_s + 8 * size / preset.bits_per_s - semtech_s(preset, size)
        assert -1e-9 <= excess_s <= preset.coding * preset.symbol_s + 1e-9


@pytest.mark.parametrize(
    ("name", "kbit_per_s"),
    [
        ("SHORT_TURBO", 21.88),
        ("SHORT_FAST", 10.94),
        ("SHORT_SLOW", 6.25),
        ("MEDIUM_FAST", 3.52),
        ("MEDIUM_SLOW", 1.95),
        ("LONG_TURBO", 1.34),
        ("LONG_FAST", 1.07),
    ],
)
def test_the_rates_are_those_that_meshtastic_states(name: str, kbit_per_s: float) -> None:
    """Its page on presets; it leaves out the optimization for low data rates, which the others have."""
    assert PRESETS[name].bits_per_s / 1000 == pytest.approx(kbit_per_s, abs=0.005)


def test_each_preset_is_one_of_the_library() -> None:
    assert set(PRESETS) <= set(config_pb2.Config.LoRaConfig.ModemPreset.keys())


def test_the_overhead_is_that_of_the_largest_packet() -> None:
    """The header of a packet on the air has 16 bytes: to, from, id, flags, channel, next hop, relay."""
    data = mesh_pb2.Data(portnum=256, payload=bytes(MAX_PAYLOAD_BYTES), bitfield=1)
    assert mesh_pb2.Constants.DATA_PAYLOAD_LEN == MAX_PAYLOAD_BYTES
    assert 16 + data.ByteSize() - MAX_PAYLOAD_BYTES == MESHTASTIC_OVERHEAD_BYTES
