"""Transmit power: hardware limits, regulatory limits, asymmetric links (MC341 to MC351)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.places import first_written
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import AntennaKind, Band, Fleet, Mesh, Node, Radio
from meshctl.regdb import CHANNELS, check_span, primary_span

# below this, a radio reaches the next room; 0 is "automatic" in other firmware
_LEAST_DBM = 4
# 47 CFR 15.247(b)(3), (b)(4), and the same in RSS-247 5.4(d): digital modulation at 2400-2483.5 and 5725-5850 MHz
_CONDUCTED_LIMIT_DBM = 30.0
_FREE_GAIN_DBI = 6.0
_CONDUCTED_COUNTRIES = frozenset({"US", "AS", "CA", "GU", "MP", "PR", "VI"})
_CONDUCTED_BANDS_MHZ = ((2400.0, 2483.5), (5725.0, 5850.0))
# drive levels are whole dBm, and the database rounds to tenths of a mW
ROUNDING_DB = 0.05
# beyond this difference a link loses acknowledgments long before data
_ASYMMETRY_DB = 10.0
# ratings are often rounded up: "1 W" can mean 28 dBm
_CLASS_TOLERANCE_DB = 3.0
# 40 dBm is 10 W, more than any robot radio; 500 or 1000 are milliwatts
_MAX_RATED_DBM = 40.0


def _dbm(value: float) -> str:
    return f"{value:g}"


def power_sum(radio: Radio) -> str:
    """The conducted power as a sum: `27 drive + 6 amplifier, at most 30 rated - 1 cable`."""
    hardware = radio.hardware
    driven = radio.tx_power_dbm + hardware.amplifier_gain_db
    text = f"{radio.tx_power_dbm} drive"
    if hardware.amplifier_gain_db:
        text += f" + {_dbm(hardware.amplifier_gain_db)} amplifier"
    if driven > hardware.rated_power_dbm:
        text += f", at most {_dbm(hardware.rated_power_dbm)} rated"
    if hardware.cable_loss_db:
        text += f" - {_dbm(hardware.cable_loss_db)} cable"
    return text


def _transmitting(fleet: Fleet) -> Iterator[tuple[Node, Radio, Mesh]]:
    for node in fleet.managed():
        for radio in node.radios:
            mesh = fleet.meshes.get(radio.mesh or "")
            if mesh is not None and mesh.channel in CHANNELS[mesh.band]:
                yield node, radio, mesh


def _has_conducted_limit(fleet: Fleet, mesh: Mesh) -> bool:
    return has_conducted_limit(fleet.country, mesh.band, mesh.channel)


def has_conducted_limit(country: str, band: Band, channel: int) -> bool:
    """Whether the limit is that of the power into the antenna."""
    span = primary_span(band, channel)
    return country in _CONDUCTED_COUNTRIES and any(
        low <= span.low_mhz and span.high_mhz <= high for low, high in _CONDUCTED_BANDS_MHZ
    )


def drive_path(fleet: Fleet, node: Node, radio: Radio) -> tuple[str, ...]:
    """The path that sets the drive level: the node's layers, or else the driver's maximum."""
    written = ("nodes", node.name, "radios", radio.name, "tx_power_dbm")
    return first_written(fleet, written, ("hardware", node.hardware.name, "radios", radio.name, "max_drive_dbm"))


@fleet_rule(
    "MC341",
    Severity.ERROR,
    "The radiated power exceeds the country's limit",
    why="""The limit applies to the radiated power: drive level plus amplifier gain, minus cable loss, plus antenna
    gain. The kernel limits only the drive level, so an amplifier or a high-gain antenna can exceed the limit
    unnoticed.""",
    fix="Lower `tx_power_dbm` by the excess.",
    failing="country: DE",
    passing="""
    country: DE
    defaults: {radios: {radio0: {tx_power_dbm: 15}}}
    """,
)
def eirp_above_country(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    country = context.regdb.country(fleet.country)
    if country is None:
        return
    limits = {
        mesh.name: check_span(country, primary_span(mesh.band, mesh.channel))
        for mesh in fleet.meshes.values()
        if mesh.channel in CHANNELS[mesh.band] and not _has_conducted_limit(fleet, mesh)
    }
    for node, radio, mesh in _transmitting(fleet):
        verdict = limits.get(mesh.name)
        if verdict is None or not verdict.covered or radio.eirp_dbm <= verdict.max_eirp_dbm + ROUNDING_DB:
            continue
        total = (
            f"{power_sum(radio)} + {_dbm(radio.hardware.antenna_gain_dbi)} antenna = {_dbm(radio.eirp_dbm)} dBm EIRP"
        )
        excess = radio.eirp_dbm - verdict.max_eirp_dbm
        expected = f"at most {_dbm(verdict.max_eirp_dbm)} dBm EIRP (country {country.alpha2}, channel {mesh.channel})"
        yield Finding(drive_path(fleet, node, radio), f"{_dbm(round(excess, 2))} dB above the limit", expected, total)


@fleet_rule(
    "MC342",
    Severity.ERROR,
    "The conducted power exceeds the FCC limit",
    why="""At 2.4 and 5.8 GHz, 47 CFR 15.247 allows 1 W (30 dBm) into the antenna, reduced by 1 dB for each dBi of
    antenna gain above 6. 2 W hardware must not be driven to its rating, nor 1 W hardware with a large sector
    antenna.""",
    fix="Lower `tx_power_dbm` by the excess, or use an antenna with less gain.",
    failing="""
    hardware: {rocket: {radios: {radio0: {rated_power_dbm: 33, amplifier_gain_db: 6, max_drive_dbm: 27}}}}
    defaults: {radios: {radio0: {tx_power_dbm: 27}}}
    """,
    passing="""
    hardware: {rocket: {radios: {radio0: {rated_power_dbm: 33, amplifier_gain_db: 6, max_drive_dbm: 27}}}}
    defaults: {radios: {radio0: {tx_power_dbm: 24}}}
    """,
)
def conducted_above_fcc(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    limited = {mesh.name for mesh in fleet.meshes.values() if _is_limited(fleet, mesh)}
    for node, radio, mesh in _transmitting(fleet):
        gain = radio.hardware.antenna_gain_dbi
        excess_gain = max(gain - _FREE_GAIN_DBI, 0.0)
        limit = conducted_limit_dbm(gain)
        if mesh.name not in limited or radio.conducted_dbm <= limit + ROUNDING_DB:
            continue
        excess = radio.conducted_dbm - limit
        less = f": 30 less {_dbm(excess_gain)} for an antenna of {_dbm(gain)} dBi" if excess_gain else ""
        allowed = f"at most {_dbm(limit)} dBm conducted (country {fleet.country}{less})"
        total = f"{power_sum(radio)} = {_dbm(radio.conducted_dbm)} dBm"
        yield Finding(drive_path(fleet, node, radio), f"{_dbm(round(excess, 2))} dB above the limit", allowed, total)


def conducted_limit_dbm(gain_dbi: float) -> float:
    """The limit behind an antenna of this gain."""
    return _CONDUCTED_LIMIT_DBM - max(gain_dbi - _FREE_GAIN_DBI, 0.0)


def _is_limited(fleet: Fleet, mesh: Mesh) -> bool:
    return mesh.channel in CHANNELS[mesh.band] and _has_conducted_limit(fleet, mesh)


@fleet_rule(
    "MC343",
    Severity.ERROR,
    "The drive level exceeds the driver's maximum",
    why="The driver silently uses its own maximum: the actual link budget is lower than planned.",
    fix="Lower `tx_power_dbm` to the profile's `max_drive_dbm`.",
    failing="nodes: {b01: {radios: {radio0: {tx_power_dbm: 29}}}}",
    passing="nodes: {b01: {radios: {radio0: {tx_power_dbm: 25}}}}",
)
def drive_above_driver(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node, radio, _ in _transmitting(fleet):
        if radio.tx_power_dbm > radio.hardware.max_drive_dbm:
            expected = f"at most {radio.hardware.max_drive_dbm} (hardware {node.hardware.name})"
            yield Finding(
                drive_path(fleet, node, radio), "above the driver's maximum", expected, str(radio.tx_power_dbm)
            )


@fleet_rule(
    "MC344",
    Severity.WARNING,
    "The amplifier is driven beyond its rating",
    why="""An overdriven amplifier distorts: high rates fail first, adjacent channels are disturbed, and it may fail
    early. A 2 W amplifier behind a full 1 W drive level is the usual case.""",
    fix="Lower `tx_power_dbm` until drive level plus amplifier gain is within the rating.",
    failing="""
    hardware: {rocket: {radios: {radio0: {rated_power_dbm: 30, amplifier_gain_db: 10}}}}
    defaults: {radios: {radio0: {tx_power_dbm: 24}}}
    """,
    passing="""
    hardware: {rocket: {radios: {radio0: {rated_power_dbm: 30, amplifier_gain_db: 10}}}}
    defaults: {radios: {radio0: {tx_power_dbm: 20}}}
    """,
)
def amplifier_overdriven(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node, radio, _ in _transmitting(fleet):
        hardware = radio.hardware
        driven = radio.tx_power_dbm + hardware.amplifier_gain_db
        if radio.tx_power_dbm <= hardware.max_drive_dbm and driven > hardware.rated_power_dbm + ROUNDING_DB:
            found = f"{radio.tx_power_dbm} drive + {_dbm(hardware.amplifier_gain_db)} amplifier = {_dbm(driven)} dBm"
            expected = f"at most {_dbm(hardware.rated_power_dbm)} dBm (hardware {node.hardware.name})"
            yield Finding(drive_path(fleet, node, radio), "above the hardware's rating", expected, found)


@fleet_rule(
    "MC345",
    Severity.WARNING,
    "The hardware cannot reach its rated power",
    why="""The profile's rating (1 W, 2 W) is more than drive level and amplifier gain add up to: either the amplifier
    is missing and every power check is too low, or the rating is wrong.""",
    fix="Correct `rated_power_dbm`, `max_drive_dbm` or `amplifier_gain_db` from the data sheet.",
    failing="hardware: {rocket: {radios: {radio0: {rated_power_dbm: 33}}}}",
    passing="hardware: {rocket: {radios: {radio0: {rated_power_dbm: 28}}}}",
)
def rating_unreachable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        for radio in profile.radios:
            most = radio.max_drive_dbm + radio.amplifier_gain_db
            if most + _CLASS_TOLERANCE_DB < radio.rated_power_dbm <= _MAX_RATED_DBM:
                path = ("hardware", profile.name, "radios", radio.name, "rated_power_dbm")
                found = f"{radio.max_drive_dbm} drive + {_dbm(radio.amplifier_gain_db)} amplifier = {_dbm(most)} dBm"
                expected = f"a sum that reaches {_dbm(radio.rated_power_dbm)} dBm"
                yield Finding(path, "drive level plus amplifier gain is below the rating", expected, found)


@fleet_rule(
    "MC346",
    Severity.ERROR,
    "A rated power looks like milliwatts",
    why="Powers are in dBm: 1 W is 30, 2 W is 33. With a much larger number, no power check is meaningful.",
    fix="Write dBm: 10 * log10(mW). 1000 mW is 30 dBm.",
    failing="hardware: {rocket: {radios: {radio0: {rated_power_dbm: 50}}}}",
    passing="hardware: {rocket: {radios: {radio0: {rated_power_dbm: 28}}}}",
)
def rating_in_milliwatts(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        for radio in profile.radios:
            if radio.rated_power_dbm > _MAX_RATED_DBM:
                path = ("hardware", profile.name, "radios", radio.name, "rated_power_dbm")
                yield Finding(path, "not a plausible power in dBm", "at most 40", _dbm(radio.rated_power_dbm))


@fleet_rule(
    "MC347",
    Severity.WARNING,
    "A directional antenna has no gain",
    why="""A sector, panel or dish antenna without gain is an incomplete profile: the radiated power is understated by
    10 dB or more, and lint misses a violation of the limit.""",
    fix="Set `antenna_gain_dbi` from the antenna's data sheet.",
    failing="hardware: {rocket: {radios: {radio0: {antenna: sector, antenna_gain_dbi: 0, beamwidth_deg: 120}}}}",
    passing="hardware: {rocket: {radios: {radio0: {antenna: sector, antenna_gain_dbi: 5, beamwidth_deg: 120}}}}",
)
def directional_without_gain(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        for radio in profile.radios:
            if radio.antenna is not AntennaKind.OMNI and radio.antenna_gain_dbi < 3:
                path = ("hardware", profile.name, "radios", radio.name, "antenna_gain_dbi")
                found = f"{_dbm(radio.antenna_gain_dbi)} dBi"
                yield Finding(path, f"a {radio.antenna.value} antenna has more gain", "at least 3 dBi", found)


@fleet_rule(
    "MC348",
    Severity.WARNING,
    "Antenna kind and beamwidth contradict each other",
    why="""Coverage and beacon placement depend on both. A 90-degree omni or a 360-degree sector is usually a copy from
    another profile.""",
    fix="Use 360 degrees for an omni, and the width of the beam for a directional antenna.",
    failing="hardware: {rocket: {radios: {radio0: {antenna: sector, beamwidth_deg: 360}}}}",
    passing="hardware: {rocket: {radios: {radio0: {antenna: sector, beamwidth_deg: 90}}}}",
)
def beamwidth_contradicts(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        for radio in profile.radios:
            if (radio.antenna is AntennaKind.OMNI) != (radio.beamwidth_deg == 360):
                place = ("hardware", profile.name, "radios", radio.name)
                path = first_written(fleet, (*place, "beamwidth_deg"), (*place, "antenna"))
                expected = "360" if radio.antenna is AntennaKind.OMNI else "less than 360"
                yield Finding(path, f"antenna is {radio.antenna.value}", expected, str(radio.beamwidth_deg))


@fleet_rule(
    "MC349",
    Severity.WARNING,
    "The transmit powers in a mesh are too far apart",
    why="""Frames from the strong radio arrive, but acknowledgments from the weak one do not: the strong node keeps
    retransmitting, and the link looks good in one direction only.""",
    fix="Bring the powers of the mesh's radios within 10 dB of each other.",
    failing="nodes: {b01: {radios: {radio0: {tx_power_dbm: 10}}}}",
    passing="nodes: {b01: {radios: {radio0: {tx_power_dbm: 20}}}}",
)
def powers_far_apart(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    by_mesh = group_by_key((mesh.name, (node, radio)) for node, radio, mesh in _transmitting(fleet))
    for name, members in by_mesh.items():
        strongest, strong = max(members, key=lambda member: member[1].conducted_dbm)
        for node, radio in members:
            if strong.conducted_dbm - radio.conducted_dbm > _ASYMMETRY_DB:
                expected = f"at least {_dbm(strong.conducted_dbm - _ASYMMETRY_DB)} dBm conducted"
                message = f"{strongest.name} in mesh {name} transmits {_dbm(strong.conducted_dbm)} dBm"
                found = f"{_dbm(radio.conducted_dbm)} dBm"
                yield Finding(drive_path(fleet, node, radio), message, expected, found)


@fleet_rule(
    "MC350",
    Severity.ERROR,
    "Two radios of a profile have the same device path",
    why="""The path identifies a radio across reboots: with a duplicate, both sections configure the same radio and the
    other stays off.""",
    fix="Read the paths from a device: `uci get wireless.radio0.path`.",
    failing="hardware: {rocket: {radios: {radio1: {path: pci0000:00/0000:00:00.0}}}}",
    passing="hardware: {rocket: {radios: {radio1: {path: pci0000:00/0000:00:01.0}}}}",
)
def radio_path_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        seen: dict[str, str] = {}
        for radio in profile.radios:
            first = seen.setdefault(radio.path, radio.name)
            if first != radio.name:
                path = ("hardware", profile.name, "radios", radio.name, "path")
                yield Finding(path, f"{first} has the same path", "a unique path", radio.path)


@fleet_rule(
    "MC351",
    Severity.WARNING,
    "A power is nearly nothing",
    why="""Powers are in dBm: 1 W is 30, 2 W is 33, and 0 dBm is 1 mW. At 2 dBm, a radio works, and hardly anything
    beyond the next room hears it. In other firmware, 0 means the most that is allowed; here it does not.""",
    fix="""Write dBm: 10 * log10(mW). Without `tx_power_dbm`, the hardware's power is used; `mesh: null` turns a radio
    off.""",
    failing="defaults: {radios: {radio0: {tx_power_dbm: 2}}}",
    passing="defaults: {radios: {radio0: {tx_power_dbm: 10}}}",
)
def power_nearly_nothing(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    expected = f"{_LEAST_DBM} dBm or more"
    for profile in fleet.hardware.values():
        for built_in in profile.radios:
            if built_in.rated_power_dbm < _LEAST_DBM:
                rating = ("hardware", profile.name, "radios", built_in.name, "rated_power_dbm")
                yield Finding(rating, "2 W is 33 dBm", expected, f"{_dbm(built_in.rated_power_dbm)} dBm")
    for node, radio, _ in _transmitting(fleet):
        if radio.tx_power_dbm + radio.hardware.amplifier_gain_db < _LEAST_DBM:
            path = drive_path(fleet, node, radio)
            yield Finding(path, "hardly anything hears it", expected, f"{radio.tx_power_dbm} dBm")
