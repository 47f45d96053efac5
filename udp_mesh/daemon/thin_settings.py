"""`[thin]` and `[[thin.links]]` of the configuration: this node's number, and the serial ports of its thin links."""

from __future__ import annotations

from dataclasses import dataclass

from udp_mesh.core.thin.lora import MESHTASTIC_OVERHEAD_BYTES, PRESETS
from udp_mesh.core.thin.settings import (
    MAX_PRESENCE_S,
    MIN_FRAME_BYTES,
    MIN_PRESENCE_S,
    ThinLinkSettings,
    ThinSettings,
)
from udp_mesh.daemon.toml_source import Table
from udp_mesh.links.meshtastic_port import MAX_HOP_LIMIT, MAX_PAYLOAD_BYTES, MESHTASTIC, MeshtasticPortConfig
from udp_mesh.links.serial_port import BAUD_RATES, SerialPortConfig
from udp_mesh.wire.framings import FRAMINGS, TRANSPARENT
from udp_mesh.wire.limits import MAX_THIN_FRAME_BYTES, MAX_THIN_NUMBER

BITS_PER_CHARACTER = 10
"""On a serial line: start bit, eight data bits, stop bit."""
MAX_BITS_PER_S = 1e6

ThinPortConfig = SerialPortConfig | MeshtasticPortConfig


def read_thin(table: Table) -> tuple[ThinSettings, tuple[ThinPortConfig, ...]]:
    """The settings and the ports; reports problems to the table's source."""
    default = ThinSettings()
    number = table.integer("number", None, 1, MAX_THIN_NUMBER)
    presence_s = table.number("presence_s", default.presence_s, MIN_PRESENCE_S, MAX_PRESENCE_S) or default.presence_s
    before = len(table.source.problems)
    links = [_read_link(entry) for entry in table.tables("links")]
    table.finish()
    if links and number is None:
        table.source.report((*table.path, "number"), f"this node's number, 1 to {MAX_THIN_NUMBER}", "none")
    names = [config.link for _, config in links]
    for name in sorted({name for name in names if names.count(name) > 1}):
        table.report("links", "each name once", name)
    if len(table.source.problems) > before:
        return default, ()
    return ThinSettings(number, tuple(link for link, _ in links), presence_s), tuple(config for _, config in links)


def _read_link(table: Table) -> tuple[ThinLinkSettings, ThinPortConfig]:
    default = ThinLinkSettings("default", 1000.0)
    device = table.text("device")
    name = table.text("name", "thin") or ""
    framing = table.choice("framing", TRANSPARENT, (*FRAMINGS, MESHTASTIC))
    if device is None:
        table.source.report((*table.path, "device"), "a serial port (/dev/serial/by-id/...)", "none")
    air, config = (_read_meshtastic if framing == MESHTASTIC else _read_serial)(table, name, device or "", framing)
    frame_bytes = table.integer("frame_bytes", air.usual_frame_bytes, MIN_FRAME_BYTES, air.max_frame_bytes)
    overhead_bytes = table.integer("frame_overhead_bytes", air.overhead_bytes, 0, 1000)
    bits_per_s = table.number("bits_per_s", air.bits_per_s, 10.0, MAX_BITS_PER_S)
    frame_s = table.number("frame_s", air.frame_s, 0.0, 10.0)
    duty_cycle = table.number("duty_cycle", default.duty_cycle, 1e-5, 1.0)
    window_s = table.number("window_s", default.window_s, 1.0, 86_400.0)
    max_airtime_s = table.number("max_airtime_s", None, 1e-3, 60.0)
    table.finish()
    if bits_per_s is None:
        table.source.report((*table.path, "bits_per_s"), "the radio's rate on the air", "none")
    try:
        link = ThinLinkSettings(
            name,
            bits_per_s or default.bits_per_s,
            frame_bytes or air.usual_frame_bytes,
            air.overhead_bytes if overhead_bytes is None else overhead_bytes,
            frame_s or 0.0,
            duty_cycle or default.duty_cycle,
            window_s or default.window_s,
            max_airtime_s,
        )
    except ValueError as error:
        expected, _, found = str(error).partition(": expected ")[2].rpartition(", found ")
        table.source.report(table.path, expected, found)
        return ThinLinkSettings("default", 1000.0), config
    return link, config


@dataclass(frozen=True, slots=True)
class _Air:
    """Defaults of a link's settings."""

    usual_frame_bytes: int
    overhead_bytes: int
    max_frame_bytes: int = MAX_THIN_FRAME_BYTES
    bits_per_s: float | None = None
    frame_s: float = 0.0


def _read_serial(table: Table, name: str, device: str, framing: str) -> tuple[_Air, ThinPortConfig]:
    baud = table.integer("baud", 57_600, 1, 10_000_000) or 57_600
    if baud not in BAUD_RATES:
        table.report("baud", "a speed that the kernel knows (9600, 57600, 115200)", baud)
    usual = FRAMINGS[framing]
    # Without a radio behind it, the line itself is the channel.
    bits_per_s = baud * 8 / BITS_PER_CHARACTER if framing == TRANSPARENT else None
    air = _Air(usual.frame_bytes, usual.overhead_bytes, bits_per_s=bits_per_s)
    return air, SerialPortConfig(name, device, baud, framing)


def _read_meshtastic(table: Table, name: str, device: str, _framing: str) -> tuple[_Air, ThinPortConfig]:
    preset = PRESETS[table.choice("preset", "LONG_FAST", PRESETS)]
    hop_limit = table.integer("hop_limit", 0, 0, MAX_HOP_LIMIT) or 0
    air = _Air(200, MESHTASTIC_OVERHEAD_BYTES, MAX_PAYLOAD_BYTES, preset.bits_per_s, preset.frame_s)
    return air, MeshtasticPortConfig(name, device, hop_limit)
