"""`iw`: `dev`, `dev IF link`, `station dump`, `survey dump` and `phy`, as in iw's own C files of these names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

from meshctl.device.observation import ChannelSurvey, RadioChip, Station, WirelessLink

MESH_POINT = "mesh point"
_INTERFACE = re.compile(r"^\s*Interface (\S+)$")
_CHANNEL = re.compile(r"channel (\d{1,3}) \((\d{3,6})(?:\.\d+)? MHz\)(?:, width: ([^,]+))?")
_STATION = re.compile(r"^Station ((?:[0-9a-f]{2}:){5}[0-9a-f]{2}) \(on (\S+)\)$", re.IGNORECASE)
_JOINED = re.compile(r"^(?:Joined IBSS|Connected to) ((?:[0-9a-f]{2}:){5}[0-9a-f]{2})", re.IGNORECASE)
_PHY = re.compile(r"^phy#(\d{1,3})$")
_SURVEY = re.compile(r"^Survey data from (\S+)$")
# `-58 [-60, -62] dBm`: all chains together, then each
_CHAINS = re.compile(r"\[(-?\d{1,3}(?:, -?\d{1,3})*)\]")
# `144.4 MBit/s MCS 15 short GI`, `866.7 MBit/s VHT-MCS 9 80MHz short GI VHT-NSS 2`, `HE-MCS 11 HE-NSS 2`, EHT likewise
_MCS = re.compile(r"((?:VHT-|HE-|EHT-)?MCS \d{1,2})\b(?:.*?\b(?:VHT|HE|EHT)-NSS (\d{1,2}))?")
_WIPHY = re.compile(r"^Wiphy (\S+)$")
_INDEX = re.compile(r"^\twiphy index: (\d{1,3})$")
_MODES = "Supported interface modes:"
_MODE = re.compile(r"^\t\t \* (\S.*)$")
# `* 2412 MHz [1] (20.0 dBm)`; iw 5.19 and later write `2412.0 MHz`
_FREQUENCY = re.compile(r"^\t\t\t\* (\d{3,6})(?:\.\d+)? MHz \[\d+\]")
_ESCAPED = re.compile(rb"\\x([0-9a-fA-F]{2})")


def parse_iw_dev(text: str) -> tuple[WirelessLink, ...] | None:
    """`iw dev`: every wireless interface. None for text that is not iw's."""
    if text.strip() and not re.search(r"^phy#\d+", text, re.MULTILINE):
        return None
    phys: dict[str, str] = {}
    phy = ""
    for line in text.splitlines():
        if found := _PHY.match(line):
            phy = f"phy{found[1]}"
        elif found := _INTERFACE.match(line):
            phys[found[1]] = phy
    return tuple(_interface(name, lines, phys.get(name, "")) for name, lines in _blocks(text, _INTERFACE))


def _interface(name: str, lines: list[str], phy: str) -> WirelessLink:
    fields = {words[0]: words[1] for line in lines if len(words := line.strip().split(" ", 1)) == 2}
    channel = next((found for line in lines if (found := _CHANNEL.search(line))), None)
    power = re.match(r"-?\d{1,3}(?:\.\d+)?", fields.get("txpower", ""))
    mode = fields.get("type", "")
    return WirelessLink(
        ifname=name,
        mode=mode,
        mac=fields.get("addr", "").lower(),
        ssid=unescape_ssid(fields["ssid"]) if "ssid" in fields else None,
        channel=int(channel[1]) if channel else None,
        frequency_mhz=int(channel[2]) if channel else None,
        width=(channel[3] or "").strip() if channel else "",
        tx_power_dbm=float(power[0]) if power else None,
        # `iw link` says `Not connected.` of every mesh point; one that has joined has a channel (cfg80211, nl80211.c)
        joined=channel is not None if mode == MESH_POINT else None,
        phy=phy,
    )


def with_link(link: WirelessLink, text: str) -> WirelessLink:
    """The interface completed by its `iw dev IF link`: the BSSID, and whether it has joined.

    An IBSS that is `up` may still be searching: then iw says `Not connected.`. It says so for a mesh point always, so
    there `joined` stays what `iw dev` showed.
    """
    first = text.strip().splitlines()[:1]
    found = _JOINED.match(first[0]) if first else None
    if found:
        return replace(link, bssid=found[1].lower(), joined=True)
    if first and first[0].startswith("Not connected") and link.mode in {"IBSS", "managed"}:
        return replace(link, joined=False)
    return link


def parse_stations(text: str) -> tuple[Station, ...] | None:
    """`iw dev IF station dump`; empty output means no station. None for text that is not iw's."""
    if text.strip() and not _STATION.match(text.strip().splitlines()[0].strip()):
        return None
    return tuple(_station(mac_and_name, lines) for mac_and_name, lines in _blocks(text, _STATION))


def _station(heading: str, lines: list[str]) -> Station:
    match = _STATION.match(heading)
    mac, name = (match[1].lower(), match[2]) if match else ("", "")
    fields = {words[0].strip(): words[1] for line in lines if len(words := line.split(":", 1)) == 2}
    return Station(
        ifname=name,
        mac=mac,
        signal_dbm=_integer(fields.get("signal")),
        inactive_ms=_integer(fields.get("inactive time")),
        tx_packets=_integer(fields.get("tx packets")),
        tx_retries=_integer(fields.get("tx retries")),
        tx_failed=_integer(fields.get("tx failed")),
        tx_mbit_s=_number(fields.get("tx bitrate")),
        rx_mbit_s=_number(fields.get("rx bitrate")),
        expected_mbit_s=_number(fields.get("expected throughput")),
        connected_s=_integer(fields.get("connected time")),
        signal_avg_dbm=_integer(fields.get("signal avg")),
        chain_signals_dbm=_chains(fields.get("signal", "")),
        tx_mcs=_mcs(fields.get("tx bitrate", "")),
        rx_mcs=_mcs(fields.get("rx bitrate", "")),
        mesh_link=fields.get("mesh plink", "").strip(),
    )


def _chains(text: str) -> tuple[int, ...]:
    found = _CHAINS.search(text)
    return tuple(int(value) for value in found[1].split(", ")) if found else ()


def _mcs(text: str) -> str:
    found = _MCS.search(text)
    if found is None:
        return ""
    return f"{found[1]} NSS {found[2]}" if found[2] else found[1]


def parse_survey(text: str) -> ChannelSurvey | None:
    """`iw dev IF survey dump`: the channel in use. None if none is (radio down), or for text that is not iw's."""
    for name, lines in _blocks(text, _SURVEY):
        fields = {words[0].strip(): words[1] for line in lines if len(words := line.split(":", 1)) == 2}
        frequency = fields.get("frequency", "")
        if "[in use]" not in frequency or (mhz := _integer(frequency)) is None:
            continue
        return ChannelSurvey(
            ifname=name,
            frequency_mhz=mhz,
            noise_dbm=_integer(fields.get("noise")),
            active_ms=_integer(fields.get("channel active time")),
            busy_ms=_integer(fields.get("channel busy time")),
        )
    return None


def parse_phys(text: str) -> tuple[RadioChip, ...] | None:
    """`iw phy`: the modes and frequencies of every radio. None for text that is not iw's."""
    if text.strip() and not re.search(r"^Wiphy ", text, re.MULTILINE):
        return None
    return tuple(_chip(name, lines) for name, lines in _blocks(text, _WIPHY))


def _chip(phy: str, lines: list[str]) -> RadioChip:
    modes: list[str] = []
    heading = ""
    for line in lines:
        if found := _INDEX.match(line):
            phy = f"phy{found[1]}"
        elif line[:1] == "\t" != line[1:2]:
            heading = line.strip()
        elif heading == _MODES and (found := _MODE.match(line)):
            modes.append(found[1])
    frequencies = (int(found[1]) for line in lines if (found := _FREQUENCY.match(line)))
    return RadioChip(phy, modes=tuple(modes), frequencies_mhz=tuple(frequencies))


def unescape_ssid(text: str) -> str:
    r"""iw writes bytes it does not print as `\xNN` (print_ssid_escaped in util.c)."""
    raw = _ESCAPED.sub(lambda match: bytes([int(match[1], 16)]), text.encode("utf-8", "surrogateescape"))
    return raw.decode("utf-8", "replace")


def _blocks(text: str, heading: re.Pattern[str]) -> Iterator[tuple[str, list[str]]]:
    """Lines grouped below each heading; the heading is its first group if it has one group, else the whole line."""
    name: str | None = None
    lines: list[str] = []
    for line in text.splitlines():
        found = heading.match(line)
        if found or line.startswith("phy#"):
            if name is not None:
                yield name, lines
            name = None
            lines = []
        if found:
            name = found[1] if heading.groups == 1 else line
        elif name is not None:
            lines.append(line)
    if name is not None:
        yield name, lines


def _number(text: str | None) -> float | None:
    found = re.match(r"\s*(-?\d{1,18}(?:\.\d{1,9})?)", text or "")
    return float(found[1]) if found else None


def _integer(text: str | None) -> int | None:
    number = _number(text)
    return None if number is None else int(number)
