"""One cell for all radios of a mesh: band, BSSID, SSID, rates, releases (MC301 to MC317)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates, group_by_key, join_limited
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.access import RSA_KEY
from meshctl.model import Band, Fleet, MeshMode, Release
from meshctl.regdb import occupied

# IEEE 802.11: the basic rates of 802.11b, and the OFDM rates of 802.11a and g
_DSSS_KBPS = (1000, 2000, 5500, 11000)
_OFDM_KBPS = (6000, 9000, 12000, 18000, 24000, 36000, 48000, 54000)
# IEEE 802.11-2020 9.4.2.2: an SSID has 0 to 32 octets
_MAX_SSID_BYTES = 32
_SECOND_MESH = """
    meshes:
      second: {ssid: SSID, bssid: "BSSID", band: 2g, channel: CHANNEL, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes:
      base: {radios: {radio0: {mesh: main}}}
      husky1-front: {radios: {radio0: {mesh: main}}}
      b01: {radios: {radio0: {mesh: main}}}
      other: {role: base, address: 10.43.0.1, radios: {radio0: {mesh: second}}}
    robots: {base-station: {nodes: [base, other]}}
    """


def _second(ssid: str, bssid: str, channel: int) -> str:
    return _SECOND_MESH.replace("BSSID", bssid).replace("SSID", ssid).replace("CHANNEL", str(channel))


@fleet_rule(
    "MC301",
    Severity.ERROR,
    "The BSSID is a group address or zero",
    why="""An ad-hoc cell's id is a unicast address; the kernel refuses to join one whose first octet is odd, and the
    radio stays silent.""",
    fix="Use a locally administered unicast address, such as 02:ca:fe:00:00:01.",
    failing="""meshes: {main: {bssid: "03:ca:fe:00:00:01"}}""",
    passing="""meshes: {main: {bssid: "02:ca:fe:00:00:01"}}""",
)
def bssid_not_unicast(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.bssid and (int(mesh.bssid[:2], 16) & 1 or mesh.bssid == "00:00:00:00:00:00"):
            yield Finding(("meshes", mesh.name, "bssid"), "not a cell's id", "a unicast address", mesh.bssid)


@fleet_rule(
    "MC302",
    Severity.WARNING,
    "The BSSID is not locally administered",
    why="""An address without the local bit belongs to some maker's device; a station of that address nearby makes the
    radios merge with it or split.""",
    fix="Set the second lowest bit of the first octet: 02, 06, 0a or 0e at its end, as in 02:ca:fe:00:00:01.",
    failing="""meshes: {main: {bssid: "00:15:6d:00:00:01"}}""",
    passing="""meshes: {main: {bssid: "02:15:6d:00:00:01"}}""",
)
def bssid_not_local(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        first = int(mesh.bssid[:2], 16) if mesh.bssid else 2
        if not first & 2 and not first & 1 and mesh.bssid != "00:00:00:00:00:00":
            expected = "a first octet with the local bit, such as 02"
            yield Finding(("meshes", mesh.name, "bssid"), "belongs to a maker", expected, mesh.bssid)


@fleet_rule(
    "MC303",
    Severity.ERROR,
    "An ad-hoc mesh has no fixed BSSID",
    why="""Radios that start out of reach of each other each make a cell with an id of its own; when they meet, merging
    is left to chance, and the mesh stays split.""",
    fix="Give the mesh a `bssid`, locally administered and unicast.",
    failing="meshes: {main: {bssid: <removed>}}",
    passing="""meshes: {main: {bssid: "02:ca:fe:00:00:01"}}""",
)
def bssid_missing(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.mode is MeshMode.ADHOC and not mesh.bssid:
            yield Finding(("meshes", mesh.name), "no fixed cell id", "a `bssid` such as 02:ca:fe:00:00:01", "none")


@fleet_rule(
    "MC304",
    Severity.ERROR,
    "Two meshes share a cell",
    why="""With one BSSID, or one SSID on one channel, the radios of both meshes join each other: two networks in one,
    with two sets of routing messages.""",
    fix="Give each mesh an SSID and a BSSID of its own.",
    failing=_second("other", "02:ca:fe:00:00:01", 11),
    passing=_second("other", "02:ca:fe:00:00:02", 11),
)
def cell_shared(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    meshes = fleet.meshes.values()
    reported: set[str] = set()
    for bssid, sharing in duplicates(((mesh.band, mesh.bssid), mesh) for mesh in meshes if mesh.bssid):
        for mesh in sharing[1:]:
            reported.add(mesh.name)
            message = f"mesh {sharing[0].name} has the same cell id"
            yield Finding(("meshes", mesh.name, "bssid"), message, "a BSSID of its own", bssid[1])
    for ssid, sharing in duplicates(((mesh.band, mesh.channel, mesh.ssid), mesh) for mesh in meshes):
        for mesh in sharing[1:]:
            if mesh.name not in reported:
                message = f"mesh {sharing[0].name} has the same SSID on the same channel"
                yield Finding(("meshes", mesh.name, "ssid"), message, "an SSID of its own", ssid[2])


@fleet_rule(
    "MC305",
    Severity.WARNING,
    "Two meshes overlap in frequency",
    why="""Cells on overlapping channels take air time from each other and cannot take turns as they would on one
    channel: each hears the other as noise.""",
    fix="Use channels that lie apart: 1, 6 and 11 at 2.4 GHz, or another band.",
    failing=_second("other", "02:ca:fe:00:00:02", 9),
    passing=_second("other", "02:ca:fe:00:00:02", 11),
)
def cells_overlap(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    spans = []
    for mesh in fleet.meshes.values():
        try:
            span = occupied(mesh.band, mesh.channel, mesh.htmode)
        except ValueError:
            continue
        if span is not None:
            spans.append((span, mesh))
    spans.sort(key=lambda pair: pair[0].low_mhz)
    if not spans:
        return
    # sorted by lower edge, a cell overlaps the one that reaches highest so far or none
    reaching, first = spans[0]
    for span, mesh in spans[1:]:
        if span.overlaps(reaching) and (mesh.ssid, mesh.channel) != (first.ssid, first.channel):
            message = f"overlaps mesh {first.name} on {reaching.low_mhz}-{reaching.high_mhz} MHz"
            found = f"{span.low_mhz}-{span.high_mhz} MHz"
            yield Finding(("meshes", mesh.name, "channel"), message, "a channel apart", found)
        if span.high_mhz > reaching.high_mhz:
            reaching, first = span, mesh


@fleet_rule(
    "MC306",
    Severity.ERROR,
    "A radio joins a mesh of another band",
    why="A 5 GHz radio cannot tune to 2.4 GHz: the interface never comes up.",
    fix="Let a radio of the mesh's band join, or mend the hardware profile's `band`.",
    failing="nodes: {base: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}}",
    passing="nodes: {base: {radios: {radio0: {mesh: main}}}}",
)
def band_differs(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        for radio in node.radios:
            mesh = fleet.meshes.get(radio.mesh or "")
            if mesh is not None and mesh.band is not radio.hardware.band:
                path = ("nodes", node.name, "radios", radio.name, "mesh")
                message = f"mesh {mesh.name} is in another band"
                yield Finding(path, message, f"a {mesh.band.value} radio", radio.hardware.band.value)


@fleet_rule(
    "MC307",
    Severity.WARNING,
    "Two radios of one node are on one channel of one mesh",
    why="""Two radios in one box deafen each other while either sends, and the mesh sees every message twice. Only
    radios on different channels add anything.""",
    fix="Leave one of the radios off, or put it in a mesh of another channel.",
    failing="""
    hardware: {rocket: {radios: {radio1: {band: 2g}}}}
    nodes: {base: {radios: {radio0: {mesh: main}, radio1: {mesh: main}}}}
    """,
    passing="nodes: {base: {radios: {radio0: {mesh: main}}}}",
)
def radios_on_one_channel(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        for name, radios in duplicates((radio.mesh, radio.name) for radio in node.radios if radio.mesh is not None):
            path = ("nodes", node.name, "radios", radios[1], "mesh")
            yield Finding(path, f"{radios[0]} is in the same cell", f"one radio in {name}", join_limited(radios))


@fleet_rule(
    "MC308",
    Severity.ERROR,
    "The SSID is longer than 32 bytes",
    why="""The standard gives an SSID 32 octets; the driver refuses a longer one and the radio stays off. Letters
    outside ASCII take several.""",
    fix="Shorten it.",
    failing="meshes: {main: {ssid: a-name-that-is-longer-than-a-beacon-can-say}}",
    passing="meshes: {main: {ssid: fleet}}",
)
def ssid_too_long(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        length = len(mesh.ssid.encode())
        if length > _MAX_SSID_BYTES:
            yield Finding(
                ("meshes", mesh.name, "ssid"), "too long", f"at most {_MAX_SSID_BYTES} bytes", f"{length} bytes"
            )


@fleet_rule(
    "MC309",
    Severity.WARNING,
    "The SSID starts or ends with a space",
    why="Nobody sees it, and a laptop that joins by hand never finds the cell.",
    fix="Take the space away.",
    failing="""meshes: {main: {ssid: "fleet "}}""",
    passing="""meshes: {main: {ssid: "fleet 1"}}""",
)
def ssid_spaces(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.ssid != mesh.ssid.strip():
            yield Finding(("meshes", mesh.name, "ssid"), "hard to see", "no space at its ends", repr(mesh.ssid))


@fleet_rule(
    "MC310",
    Severity.ERROR,
    "An apostrophe in the SSID breaks OpenWrt 25.12",
    why="""25.12's wifi scripts put the configuration between apostrophes on a shell's command line: one in the SSID
    ends it there, the interface does not come up, and what follows is run.""",
    fix="Choose an SSID without an apostrophe.",
    failing="""
    hardware: {rocket: {release: "25.12"}}
    meshes: {main: {ssid: "bob's fleet", mode: mesh, encryption: sae}}
    """,
    passing="""meshes: {main: {ssid: "bob's fleet"}}""",
)
def ssid_apostrophe(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if "'" in mesh.ssid and Release.V25_12 in _releases(fleet).get(mesh.name, {}):
            yield Finding(("meshes", mesh.name, "ssid"), "breaks on OpenWrt 25.12", "no apostrophe", mesh.ssid)


def _releases(fleet: Fleet) -> dict[str, dict[Release, list[str]]]:
    """The names of every mesh's members by release."""
    members = group_by_key((mesh, node) for node in fleet.managed() for mesh in node.meshes)
    return {mesh: group_by_key((node.release, node.name) for node in nodes) for mesh, nodes in members.items()}


@fleet_rule(
    "MC311",
    Severity.NOTE,
    "One mesh runs several OpenWrt releases",
    why="""They work together, but each brings its own batman-adv and drivers: what was tested on one is not tested on
    the mixture.""",
    fix="Bring the older nodes to the newer release when there is time.",
    failing="""
    nodes: {b01: {release: "23.05"}}
    """,
    passing="""
    nodes: {b01: {release: "24.10"}}
    """,
)
def releases_mixed(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh, releases in _releases(fleet).items():
        if mesh in fleet.meshes and len(releases) > 1:
            found = ", ".join(f"{release}: {join_limited(names)}" for release, names in sorted(releases.items()))
            yield Finding(("meshes", mesh), "its members run several releases", "one release", found)


@fleet_rule(
    "MC312",
    Severity.WARNING,
    "Ad-hoc mode on OpenWrt 19.07",
    why="""Trouble of ath9k's ad-hoc mode under batman-adv is on record for 19.07 (lime-packages#855): nodes that stay
    in the cell and pass no traffic.""",
    fix="Move these nodes to a newer release, or set `mode: mesh`.",
    failing=Example(
        f"""
        nodes: {{b01: {{release: "19.07"}}}}
        operators: {{ssh_keys: ["{RSA_KEY}"]}}
        """,
        also=("MC311",),
    ),
    passing="""nodes: {b01: {release: "24.10"}}""",
)
def adhoc_on_19_07(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    releases = _releases(fleet)
    for mesh in fleet.meshes.values():
        old = releases.get(mesh.name, {}).get(Release.V19_07, [])
        if old and mesh.mode is MeshMode.ADHOC:
            message = "ad-hoc mode is not dependable on 19.07"
            yield Finding(("meshes", mesh.name, "mode"), message, "21.02 or later, or mode mesh", join_limited(old))


@fleet_rule(
    "MC313",
    Severity.ERROR,
    "The broadcast rate is no rate of the band",
    why="The driver refuses the rate and the interface does not come up, or it falls back to the lowest.",
    fix="Use 6000, 9000, 12000, 18000, 24000, 36000, 48000 or 54000 (also 1000, 2000, 5500, 11000 at 2.4 GHz).",
    failing="meshes: {main: {mcast_rate_kbps: 13000}}",
    passing="meshes: {main: {mcast_rate_kbps: 12000}}",
)
def broadcast_rate_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        rates = _OFDM_KBPS if mesh.band is Band.G5 else tuple(sorted(_DSSS_KBPS + _OFDM_KBPS))
        if mesh.mcast_rate_kbps not in rates:
            expected = f"one of {', '.join(map(str, rates))}"
            path = ("meshes", mesh.name, "mcast_rate_kbps")
            yield Finding(path, "not a rate of the band", expected, str(mesh.mcast_rate_kbps))


@fleet_rule(
    "MC314",
    Severity.WARNING,
    "The broadcast rate is low",
    why="""Originator messages at 1 Mbit/s reach far beyond where data can follow: BATMAN_IV then prefers one long weak
    link to two good ones, and every broadcast takes twelve times the air.""",
    fix="Set `mcast_rate_kbps` to 12000, or 6000 for long open links.",
    failing="meshes: {main: {mcast_rate_kbps: 1000}}",
    passing="meshes: {main: {mcast_rate_kbps: 6000}}",
)
def broadcast_rate_low(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.mcast_rate_kbps in _DSSS_KBPS and mesh.band is Band.G2 and mesh.mcast_rate_kbps < _OFDM_KBPS[0]:
            path = ("meshes", mesh.name, "mcast_rate_kbps")
            yield Finding(path, "favours long weak links", "at least 6000", str(mesh.mcast_rate_kbps))


@fleet_rule(
    "MC315",
    Severity.WARNING,
    "The distance for acknowledgements is too short",
    why="""A radio gives up on an acknowledgement that arrives later than `distance_m` allows and sends again, though
    the frame arrived: a link beyond it loses nearly all its throughput.""",
    fix="Set `distance_m` to the longest link you expect; a few hundred metres too many cost next to nothing.",
    failing="meshes: {main: {distance_m: 50}}",
    passing="meshes: {main: {distance_m: 500}}",
)
def distance_short(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # the kernel counts coverage classes of 450 m (IEEE 802.11-2020 9.4.2.8: 3 us of air each way)
    for mesh in fleet.meshes.values():
        if mesh.distance_m < 100:
            path = ("meshes", mesh.name, "distance_m")
            yield Finding(path, "links beyond it fail", "the longest link, at least 100", str(mesh.distance_m))


@fleet_rule(
    "MC316",
    Severity.WARNING,
    "The distance for acknowledgements is very long",
    why="""After each lost frame the radio waits this long before it sends again: 30 km cost 200 microseconds each time,
    for every node of the cell.""",
    fix="Set `distance_m` to the longest link you expect.",
    failing="meshes: {main: {distance_m: 60000}}",
    passing="meshes: {main: {distance_m: 3000}}",
)
def distance_long(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.distance_m > 30_000:
            path = ("meshes", mesh.name, "distance_m")
            yield Finding(path, "every loss waits for it", "at most 30000", str(mesh.distance_m))


@fleet_rule(
    "MC317",
    Severity.WARNING,
    "The beacon interval is unusual",
    why="""Short intervals fill the channel with beacons of every node; long ones keep a node that comes into reach from
    joining the cell for seconds.""",
    fix="Keep 100, the standard's usual value.",
    failing="meshes: {main: {beacon_interval_tu: 2000}}",
    passing="meshes: {main: {beacon_interval_tu: 100}}",
)
def beacon_interval(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if not 50 <= mesh.beacon_interval_tu <= 1000:
            path = ("meshes", mesh.name, "beacon_interval_tu")
            yield Finding(path, "beacons too dense or too rare", "50 to 1000", str(mesh.beacon_interval_tu))
