"""`[thin]` and `[[thin.links]]` of the configuration: this node's number, and the serial ports of its thin links."""

from __future__ import annotations

from udp_mesh.core.thin.settings import (
    MAX_PRESENCE_S,
    MIN_FRAME_BYTES,
    MIN_PRESENCE_S,
    ThinLinkSettings,
    ThinSettings,
)
from udp_mesh.daemon.toml_source import Table
from udp_mesh.links.serial_port import BAUD_RATES, SerialPortConfig
from udp_mesh.wire.framings import FRAMINGS, TRANSPARENT
from udp_mesh.wire.limits import MAX_THIN_FRAME_BYTES, MAX_THIN_NUMBER

BITS_PER_CHARACTER = 10
"""On a serial line: start bit, eight data bits, stop bit."""
MAX_BITS_PER_S = 1e6


def read_thin(table: Table) -> tuple[ThinSettings, tuple[SerialPortConfig, ...]]:
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


def _read_link(table: Table) -> tuple[ThinLinkSettings, SerialPortConfig]:
    default = ThinLinkSettings("default", 1000.0)
    device = table.text("device")
    name = table.text("name", "thin") or ""
    baud = table.integer("baud", 57_600, 1, 10_000_000) or 57_600
    bits_per_s = table.number("bits_per_s", None, 10.0, MAX_BITS_PER_S)
    framing = table.choice("framing", TRANSPARENT, FRAMINGS)
    usual = FRAMINGS[framing]
    frame_bytes = table.integer("frame_bytes", usual.frame_bytes, MIN_FRAME_BYTES, MAX_THIN_FRAME_BYTES)
    overhead_bytes = table.integer("frame_overhead_bytes", usual.overhead_bytes, 0, 1000)
    frame_s = table.number("frame_s", default.frame_s, 0.0, 10.0)
    duty_cycle = table.number("duty_cycle", default.duty_cycle, 1e-5, 1.0)
    window_s = table.number("window_s", default.window_s, 1.0, 86_400.0)
    max_airtime_s = table.number("max_airtime_s", None, 1e-3, 60.0)
    table.finish()
    if device is None:
        table.source.report((*table.path, "device"), "a serial port (/dev/serial/by-id/...)", "none")
    if baud not in BAUD_RATES:
        table.report("baud", "a speed that the kernel knows (9600, 57600, 115200)", baud)
    if framing != TRANSPARENT and bits_per_s is None:
        table.source.report((*table.path, "bits_per_s"), "the radio's rate on the air", "none")
    # Without a radio behind it, the line itself is the channel.
    rate = baud * 8 / BITS_PER_CHARACTER if bits_per_s is None else bits_per_s
    config = SerialPortConfig(name, device or "", baud, framing)
    try:
        link = ThinLinkSettings(
            name,
            rate,
            frame_bytes or usual.frame_bytes,
            usual.overhead_bytes if overhead_bytes is None else overhead_bytes,
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
