"""The channel: legal in the country, usable in the mesh's mode, at its width (MC321 to MC334)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Band, Fleet, Mesh, MeshMode, Release
from meshctl.regdb import (
    CHANNELS,
    NO_INITIATE,
    Country,
    Flag,
    Legality,
    check_span,
    initiating_channels,
    legal_channels,
    occupied_span,
    primary_span,
    width_mhz,
)

# the only build whose wifi-scripts declare `mcast_rate` as an array (docs/facts/openwrt-checked.md)
_NO_MCAST_RATE = "25.12.0-rc1"
_IMAGE = 'image for {"supported_devices":["ubnt,rocket-m"],"version":{"version":"%s","revision":"r1-1"}}'


def format_channels(channels: tuple[int, ...]) -> str:
    """`one of 1-11`, `one of 36, 40, 44, 48`."""
    return f"one of {_listed(channels)}" if channels else "another band"


def _listed(channels: tuple[int, ...]) -> str:
    run = range(channels[0], channels[-1] + 1)
    return f"{channels[0]}-{channels[-1]}" if channels == tuple(run) else ", ".join(map(str, channels))


def channel_or_width(channels: tuple[int, ...]) -> str:
    """The advice for a channel that may not be so wide: one of the channels that may, if there are any."""
    return f"a channel of {_listed(channels)}" if channels else "a narrower htmode"


def _country(fleet: Fleet, context: LintContext) -> Country | None:
    return context.regdb.country(fleet.country)


def _channels(fleet: Fleet, context: LintContext) -> Iterator[tuple[Mesh, Country, Legality]]:
    """Every mesh whose channel exists, with the legality of its primary 20 MHz."""
    country = _country(fleet, context)
    if country is None:
        return
    for mesh in fleet.meshes.values():
        if mesh.channel in CHANNELS[mesh.band]:
            yield mesh, country, check_span(country, primary_span(mesh.band, mesh.channel))


def _wide_channels(fleet: Fleet, context: LintContext) -> Iterator[tuple[Mesh, Country, Legality, int]]:
    """Meshes wider than 20 MHz with a legal primary channel, with the legality of the whole width, and the width."""
    for mesh, country, verdict in _channels(fleet, context):
        if not verdict.covered or mesh.htmode not in _known_htmodes(mesh.band):
            continue
        span = occupied_span(mesh.band, mesh.channel, mesh.htmode)
        if span is not None and span.width_mhz > 20:
            yield mesh, country, check_span(country, span), span.width_mhz


def _known_htmodes(band: Band) -> tuple[str, ...]:
    common = ("NOHT", "HT20", "HT40", "HT40+", "HT40-", "HE20", "HE40", "EHT20", "EHT40")
    wide = ("VHT20", "VHT40", "VHT80", "VHT160", "HE80", "HE160", "EHT80", "EHT160")
    return common if band is Band.G2 else common + wide


@fleet_rule(
    "MC321",
    Severity.ERROR,
    "The country is not in the regulatory database",
    why="""The kernel falls back to the world regulatory domain, where most channels may not be used to start a cell:
    radios come up weak or not at all.""",
    fix="Use the ISO 3166-1 code of the country you transmit in.",
    failing="country: XX",
    passing="country: CA",
)
def country_unknown(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    if _country(fleet, context) is None:
        yield Finding(("country",), "not in the regulatory database", "a country such as US or DE", fleet.country)


@fleet_rule(
    "MC322",
    Severity.ERROR,
    "The band has no such channel",
    why="The channel number belongs to another band or to none: the interface does not come up.",
    fix="Choose a channel of the mesh's band.",
    failing="meshes: {main: {channel: 36}}",
    passing="meshes: {main: {channel: 11}}",
)
def channel_unknown(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    country = _country(fleet, context)
    for mesh in fleet.meshes.values():
        if mesh.channel not in CHANNELS[mesh.band]:
            legal = initiating_channels(country, mesh.band)
            path = ("meshes", mesh.name, "channel")
            message = f"not a channel of the {mesh.band.value} band"
            yield Finding(path, message, format_channels(legal), str(mesh.channel))


@fleet_rule(
    "MC323",
    Severity.ERROR,
    "The channel is not allowed in the country",
    why="""The kernel disables the channel: the radio does not start. Setting another country code to enable it is
    illegal and interferes with other users of the frequency.""",
    fix="Choose a channel that the country allows.",
    failing="meshes: {main: {channel: 13}}",
    passing="""
    country: CA
    meshes: {main: {channel: 13}}
    """,
)
def channel_illegal(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for mesh, country, verdict in _channels(fleet, context):
        if not verdict.covered:
            legal = format_channels(initiating_channels(country, mesh.band))
            path = ("meshes", mesh.name, "channel")
            yield Finding(path, "not allowed in this country", f"{legal} (country {country.alpha2})", str(mesh.channel))


@fleet_rule(
    "MC324",
    Severity.ERROR,
    "The channel requires radar detection (DFS), which ad-hoc mode lacks",
    why="""On DFS channels a master station must detect radar and move the others. An ad-hoc cell has no master, and
    mac80211 refuses to join.""",
    fix="Choose a channel without DFS.",
    failing="""
    meshes: {main: {band: 5g, channel: 52}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    """,
    passing="""
    meshes: {main: {band: 5g, channel: 149}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    """,
)
def channel_needs_radar_detection(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _radar(fleet, context, MeshMode.ADHOC, "requires radar detection")


@fleet_rule(
    "MC325",
    Severity.WARNING,
    "The channel must be vacated when radar is detected",
    why="""802.11s supports DFS channels, but the radio stays silent for at least a minute before it starts, and a radar
    pulse (or a false detection) takes the whole cell off the air during a run.""",
    fix="Choose a channel without DFS.",
    failing="""
    meshes: {main: {band: 5g, channel: 52, mode: mesh, encryption: sae}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    hardware: {rocket: {confirm_window_s: 200}}
    """,
    passing="""
    meshes: {main: {band: 5g, channel: 149, mode: mesh, encryption: sae}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    """,
)
def channel_may_be_lost(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _radar(fleet, context, MeshMode.MESH, "must be vacated when radar is detected")


def _radar(fleet: Fleet, context: LintContext, mode: MeshMode, message: str) -> Iterator[Finding]:
    for mesh, country, verdict in _channels(fleet, context):
        if mesh.mode is mode and verdict.covered and Flag.DFS in verdict.flags:
            legal = format_channels(initiating_channels(country, mesh.band))
            path = ("meshes", mesh.name, "channel")
            yield Finding(path, message, f"{legal} (country {country.alpha2})", f"{mesh.channel} (DFS)")


@fleet_rule(
    "MC326",
    Severity.ERROR,
    "The channel does not allow starting a cell (no-IR)",
    why="""The country marks the channel no-IR: stations must not initiate radiation. A mesh of such stations stays
    silent.""",
    fix="Choose a channel without this restriction.",
    failing="""
    meshes: {main: {band: 5g, channel: 173}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    """,
    passing="""
    meshes: {main: {band: 5g, channel: 149}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    """,
)
def channel_passive(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for mesh, country, verdict in _channels(fleet, context):
        if verdict.covered and Flag.NO_IR in verdict.flags and Flag.DFS not in verdict.flags:
            legal = format_channels(initiating_channels(country, mesh.band))
            path = ("meshes", mesh.name, "channel")
            expected = f"{legal} (country {country.alpha2})"
            yield Finding(path, "stations may not initiate transmission", expected, f"{mesh.channel} (no-IR)")


@fleet_rule(
    "MC327",
    Severity.ERROR,
    "The channel is not available at this width",
    why="""The secondary channel would be outside the band: the driver rejects it, or the radio comes up narrower than
    its neighbors and cannot hear them.""",
    fix="Use HT20, or a channel with room on that side.",
    failing="""
    meshes: {main: {band: 5g, channel: 36, htmode: HT40-}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    """,
    passing="""
    meshes: {main: {band: 5g, channel: 36, htmode: HT40+}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    """,
)
def width_without_room(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for mesh, country, verdict in _channels(fleet, context):
        if not verdict.covered or mesh.htmode not in _known_htmodes(mesh.band):
            continue
        if occupied_span(mesh.band, mesh.channel, mesh.htmode) is None:
            legal = legal_channels(country, mesh.band, mesh.htmode, forbidden=NO_INITIATE)
            message = f"no room next to channel {mesh.channel}"
            yield Finding(("meshes", mesh.name, "htmode"), message, channel_or_width(legal), mesh.htmode)


@fleet_rule(
    "MC328",
    Severity.ERROR,
    "The channel is too wide for the country",
    why="""Part of the bonded channel is forbidden in the country, requires radar detection, or allows only narrower
    channels: the kernel rejects it, or narrows it on this node alone.""",
    fix="Use HT20, or another channel.",
    failing="""
    meshes: {main: {band: 5g, channel: 36, htmode: VHT160}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    """,
    passing="""
    meshes: {main: {band: 5g, channel: 36, htmode: VHT80}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
    """,
)
def width_illegal(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for mesh, country, verdict, width in _wide_channels(fleet, context):
        silent = verdict.flags & NO_INITIATE if verdict.covered else Flag(0)
        own = check_span(country, primary_span(mesh.band, mesh.channel)).flags & NO_INITIATE
        if verdict.allows(width) and (not silent or own):
            continue
        legal = legal_channels(country, mesh.band, mesh.htmode, forbidden=NO_INITIATE)
        expected = channel_or_width(legal) + (f" (country {country.alpha2})" if legal else "")
        message = f"channel {mesh.channel} may not be {width} MHz wide"
        yield Finding(("meshes", mesh.name, "htmode"), message, expected, mesh.htmode)


@fleet_rule(
    "MC329",
    Severity.ERROR,
    "The htmode is not valid for the band",
    why="""OpenWrt silently ignores an unknown htmode, and the radio falls back to 802.11g rates: less than half the
    throughput.""",
    fix="Use HT20, or at 5 GHz HT40, VHT20, VHT40 or VHT80 if the hardware supports them.",
    failing="meshes: {main: {htmode: VHT80}}",
    passing="meshes: {main: {htmode: HT20}}",
)
def htmode_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        known = _known_htmodes(mesh.band)
        if mesh.htmode not in known or mesh.htmode == "NOHT":
            path = ("meshes", mesh.name, "htmode")
            wanted = f"one of {', '.join(mode for mode in known if mode != 'NOHT')}"
            yield Finding(path, f"not an htmode of the {mesh.band.value} band", wanted, mesh.htmode)


@fleet_rule(
    "MC330",
    Severity.ERROR,
    "OpenWrt 25.12 drops HT40+ and HT40- in ad-hoc mode",
    why="""The scripts of 25.12 accept only HT20 and HT40 for ad-hoc cells; with a sign, the radio joins without HT, at
    less than half the throughput of its neighbors.""",
    fix="Use HT40 or HT20.",
    failing=Example(
        """
        hardware: {rocket: {release: "25.12"}}
        meshes: {main: {channel: 149, band: 5g, htmode: HT40+, encryption: none, key: <removed>}}
        defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
        """,
        also=("MC408",),
    ),
    passing=Example(
        """
        hardware: {rocket: {release: "25.12"}}
        meshes: {main: {channel: 149, band: 5g, htmode: HT40, encryption: none, key: <removed>}}
        defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
        """,
        also=("MC408",),
    ),
)
def htmode_sign_on_25_12(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    new = {mesh for node in fleet.managed() if node.release >= Release.V25_12 for mesh in node.meshes}
    for mesh in fleet.meshes.values():
        if mesh.name in new and mesh.mode is MeshMode.ADHOC and mesh.htmode in ("HT40+", "HT40-"):
            path = ("meshes", mesh.name, "htmode")
            yield Finding(path, "falls back to no HT on OpenWrt 25.12", "HT40 or HT20", mesh.htmode)


@fleet_rule(
    "MC331",
    Severity.WARNING,
    "40 MHz channel at 2.4 GHz",
    why="""It takes half of a band that has room for three cells, doubles the noise bandwidth, and collides with every
    hotspot and every robot's own Wi-Fi. On long links it is slower than HT20.""",
    fix="Use HT20 at 2.4 GHz.",
    failing="meshes: {main: {htmode: HT40}}",
    passing="meshes: {main: {htmode: HT20}}",
)
def wide_at_2g(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.band is Band.G2 and mesh.htmode in _known_htmodes(Band.G2) and width_mhz(mesh.htmode) > 20:
            yield Finding(("meshes", mesh.name, "htmode"), "takes half the band", "HT20", mesh.htmode)


@fleet_rule(
    "MC332",
    Severity.NOTE,
    "The channel is not 1, 6 or 11",
    why="""Most other cells use 1, 6 and 11. A channel in between is disturbed by two of them and can coordinate with
    neither.""",
    fix="Use 1, 6 or 11 (where 13 is allowed, 5, 9 and 13 do not overlap either).",
    failing="meshes: {main: {channel: 4}}",
    passing="meshes: {main: {channel: 11}}",
)
def channel_between(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for mesh, _, verdict in _channels(fleet, context):
        if mesh.band is Band.G2 and verdict.covered and mesh.channel not in (1, 5, 6, 9, 11, 13):
            found = f"{mesh.channel}"
            yield Finding(("meshes", mesh.name, "channel"), "between the usual channels", "one of 1, 6, 11", found)


@fleet_rule(
    "MC333",
    Severity.WARNING,
    "The channel is for indoor use only",
    why="""The country allows the channel inside buildings only. A mine or a cave may count as indoors; the staging area
    does not.""",
    fix="Choose a channel without this restriction if any radio operates outdoors.",
    failing="""
    country: DE
    meshes: {main: {band: 5g, channel: 36}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main, tx_power_dbm: 17}}}
    """,
    passing="""
    country: US
    meshes: {main: {band: 5g, channel: 36}}
    defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main, tx_power_dbm: 17}}}
    """,
)
def channel_indoor(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for mesh, country, verdict in _channels(fleet, context):
        if verdict.covered and Flag.NO_OUTDOOR in verdict.flags and not verdict.flags & NO_INITIATE:
            outdoor = legal_channels(country, mesh.band, "HT20", forbidden=NO_INITIATE | Flag.NO_OUTDOOR)
            expected = f"{format_channels(outdoor)} (country {country.alpha2})"
            yield Finding(("meshes", mesh.name, "channel"), "indoor use only", expected, str(mesh.channel))


@fleet_rule(
    "MC334",
    Severity.WARNING,
    "OpenWrt 25.12.0-rc1 cannot join ad-hoc cells",
    why="""The wifi scripts of this build treat `mcast_rate` as a list and pass no number to `iw`, so the radio cannot
    join a cell. 25.12.0-rc2 and later are not affected.""",
    fix="Use an image of 25.12.0 or later.",
    failing=Example(
        """
        hardware: {rocket: {release: "25.12", firmware: {image: rc1.bin, sha256: <sha256 of rc1.bin>, revision: r1}}}
        meshes: {main: {encryption: none, key: <removed>}}
        """,
        files={"rc1.bin": _IMAGE % "25.12.0-rc1"},
        also=("MC408",),
    ),
    passing=Example(
        """
        hardware: {rocket: {release: "25.12", firmware: {image: new.bin, sha256: <sha256 of new.bin>, revision: r1}}}
        meshes: {main: {encryption: none, key: <removed>}}
        """,
        files={"new.bin": _IMAGE % "25.12.0"},
        also=("MC408",),
    ),
)
def multicast_rate_on_25_12_0_rc1(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    adhoc = {mesh.name for mesh in fleet.meshes.values() if mesh.mode is MeshMode.ADHOC}
    used = {node.hardware.name for node in fleet.managed() if adhoc.intersection(node.meshes)}
    for profile in fleet.hardware.values():
        is_asked = profile.name in used and profile.release >= Release.V25_12
        version = context.files.image_version(profile) if is_asked else ""
        if version == _NO_MCAST_RATE:
            path = ("hardware", profile.name, "firmware", "image")
            yield Finding(path, "cannot join ad-hoc cells", "25.12.0 or later", version)
