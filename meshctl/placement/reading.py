"""A reading of the placement meter for people: JSON, large digits, spoken words. Pure."""

from __future__ import annotations

import math
from typing import Any

from meshctl.placement.meter import Advice, Reading

VERSION = 1
SPEAK_EVERY_S = 5.0
"""GO is repeated this often; what needs action, every two seconds."""
SPEAK_ACTION_EVERY_S = 2.0

_DIGITS = {
    "0": ("███", "█ █", "█ █", "█ █", "███"),
    "1": ("  █", "  █", "  █", "  █", "  █"),
    "2": ("███", "  █", "███", "█  ", "███"),
    "3": ("███", "  █", "███", "  █", "███"),
    "4": ("█ █", "█ █", "███", "  █", "  █"),
    "5": ("███", "█  ", "███", "  █", "███"),
    "6": ("███", "█  ", "███", "█ █", "███"),
    "7": ("███", "  █", "  █", "  █", "  █"),
    "8": ("███", "█ █", "███", "█ █", "███"),
    "9": ("███", "█ █", "███", "  █", "███"),
    "-": ("   ", "   ", "███", "   ", "   "),
    "+": ("   ", " █ ", "███", " █ ", "   "),
    "?": ("███", "  █", " ██", "   ", " █ "),
}
_STYLES = {Advice.GO: "ok", Advice.DROP_SOON: "warning", Advice.DROP_NOW: "error", Advice.TURN_BACK: "error"}


def reading_json(robot: str, reading: Reading, bytes_per_s: float | None = None) -> dict[str, Any]:
    """One line of `meshctl meter --json`; an unknown value is null."""
    place = reading.last_good
    return {
        "version": VERSION,
        "robot": robot,
        "time_s": round(reading.now_s, 3),
        "advice": reading.advice.value,
        "reason": reading.reason or None,
        "margin_db": _rounded(reading.margin_db),
        "bottleneck_db": _rounded(reading.bottleneck_db),
        "snr_db": _rounded(reading.snr_db),
        "fade_db": _rounded(reading.fade_db),
        "next_hop": reading.next_hop or None,
        "hops": reading.hops,
        "rate_mbit_s": _rounded(reading.rate_mbit_s),
        "slope_db_per_m": _rounded(reading.slope_db_per_m, 3),
        "meters_left": _rounded(reading.meters_left),
        "turn_loss_db": _rounded(reading.turn_loss_db),
        "last_good": None if place is None else {"x_m": place[0], "y_m": place[1], "z_m": place[2]},
        "back_m": _rounded(reading.back_m),
        "beacons": reading.beacons,
        "depth_left_m": _rounded(reading.depth_left_m),
        "bytes_per_s": _rounded(bytes_per_s),
    }


def _rounded(value: float | None, digits: int = 1) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def _whole(value: float) -> int:
    """Rounded down: half a decibel is not there yet."""
    return math.floor(value)


def style_of(advice: Advice) -> str:
    """The style's name for `paint`."""
    return _STYLES[advice]


def large(text: str, scale: int = 2) -> list[str]:
    """The text in block digits: `scale` columns per block, five rows times half the scale."""
    rows = []
    for row in range(5):
        line = "  ".join("".join(block * scale for block in _DIGITS.get(letter, _DIGITS["?"])[row]) for letter in text)
        rows += [line.rstrip()] * max(1, scale // 2)
    return rows


def page(robot: str, reading: Reading, columns: int, footer: str) -> list[str]:
    """The screen: advice, the margin in large digits, and the figures below."""
    scale = 4 if columns >= 80 else 2
    margin = "?" if reading.margin_db is None else f"{_whole(reading.margin_db):+d}"
    lines = [f"{robot}   {reading.advice.value}{f'   {reading.reason}' if reading.reason else ''}", ""]
    lines += large(margin, scale)
    lines += ["", f"dB of margin to {reading.next_hop or 'no relay'}", ""]
    lines.append(_figures(reading))
    if reading.back_m is not None and reading.advice is Advice.TURN_BACK:
        lines.append(f"last place with a margin: {reading.back_m:.0f} m back")
    return [*lines, "", footer]


def _figures(reading: Reading) -> str:
    def shown(value: float | None, unit: str, form: str = ".0f") -> str:
        return "?" if value is None else f"{value:{form}} {unit}"

    parts = [
        f"left {shown(reading.meters_left, 'm')}",
        f"bottleneck {shown(reading.bottleneck_db, 'dB')}",
        f"hops {'?' if reading.hops is None else reading.hops}",
        f"rate {shown(reading.rate_mbit_s, 'Mbit/s', '.1f')}",
        f"slope {shown(reading.slope_db_per_m, 'dB/m', '.2f')}",
    ]
    if reading.beacons is not None:
        parts.append(f"beacons {reading.beacons}")
    if reading.depth_left_m is not None:
        parts.append(f"the remaining beacons cover {reading.depth_left_m:.0f} m")
    return "   ".join(parts)


def line(robot: str, reading: Reading) -> str:
    """One line, for pipes and logs."""
    margin = "?" if reading.margin_db is None else f"{_whole(reading.margin_db)} dB"
    reason = f" ({reading.reason})" if reading.reason else ""
    advice = f"{robot} {reading.advice.value}{reason}"
    return f"{advice}: margin {margin} to {reading.next_hop or 'no relay'}, {_figures(reading)}"


def words(reading: Reading) -> str:
    """The text to speak."""
    if reading.advice is Advice.TURN_BACK:
        back = "" if not reading.back_m else f", {reading.back_m:.0f} meters"
        return f"turn back{back}"
    if reading.advice is Advice.DROP_NOW:
        return "drop now"
    number = "unknown" if reading.margin_db is None else f"{_whole(reading.margin_db)}"
    return f"drop soon, {number}" if reading.advice is Advice.DROP_SOON else number


def is_due_to_speak(reading: Reading, last: Reading | None) -> bool:
    """Whether to speak this reading after the last spoken one."""
    if last is None or reading.advice is not last.advice:
        return True
    period_s = SPEAK_EVERY_S if reading.advice is Advice.GO else SPEAK_ACTION_EVERY_S
    return reading.now_s - last.now_s >= period_s
