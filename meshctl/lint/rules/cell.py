"""One cell for all radios of a mesh: band, BSSID, SSID, rates, releases (MC301 to MC317)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates, group_by_key
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.access import RSA_KEY
from meshctl.model import Band, Fleet, Mesh, MeshMode, Release
from meshctl.regdb import occupied_span
from meshctl.wording import join_limited

# IEEE 802.11: the basic rates of 802.11b, and the OFDM rates of 802.11a and g
_DSSS_KBPS = (1000, 2000, 5500, 11000)
OFDM_KBPS = (6000, 9000, 12000, 18000, 24000, 36000, 48000, 54000)
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


def second_mesh(ssid: str, bssid: str, channel: int) -> str:
    """The example of a fleet with a mesh of another network beside the first one."""
    return _SECOND_MESH.replace("BSSID", bssid).replace("SSID", ssid).replace("CHANNEL", str(channel))


@fleet_rule(
    "MC301",
    Severity.ERROR,
    "The BSSID is not a unicast address",
    why="""An ad-hoc cell needs a unicast BSSID. The kernel refuses to join a cell with a group address (odd first
    octet) or zero, and the radio stays silent.""",
    fix="Use a locally administered unicast address, such as 02:ca:fe:00:00:01.",
    failing="""meshes: {main: {bssid: "03:ca:fe:00:00:01"}}""",
    passing="""meshes: {main: {bssid: "02:ca:fe:00:00:01"}}""",
)
def bssid_not_unicast(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.bssid and (int(mesh.bssid[:2], 16) & 1 or mesh.bssid == "00:00:00:00:00:00"):
            yield Finding(("meshes", mesh.name, "bssid"), "BSSID must be unicast", "a unicast address", mesh.bssid)


@fleet_rule(
    "MC302",
    Severity.WARNING,
    "The BSSID is not locally administered",
    why="""An address without the locally-administered bit belongs to a manufacturer's device; a nearby station with
    that address makes the radios merge with it or split.""",
    fix="Set the second-lowest bit of the first octet (x2, x6, xa or xe), as in 02:ca:fe:00:00:01.",
    failing="""meshes: {main: {bssid: "00:15:6d:00:00:01"}}""",
    passing="""meshes: {main: {bssid: "02:15:6d:00:00:01"}}""",
)
def bssid_not_local(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        first = int(mesh.bssid[:2], 16) if mesh.bssid else 2
        if not first & 2 and not first & 1 and mesh.bssid != "00:00:00:00:00:00":
            expected = "a first octet with the local bit, such as 02"
            yield Finding(("meshes", mesh.name, "bssid"), "BSSID must be locally administered", expected, mesh.bssid)


@fleet_rule(
    "MC303",
    Severity.ERROR,
    "An ad-hoc mesh has no fixed BSSID",
    why="""Radios that start out of range of each other each create a cell with its own BSSID. When they meet, merging
    is unreliable, and the mesh stays split.""",
    fix="Set `bssid` to a locally administered unicast address.",
    failing="meshes: {main: {bssid: <removed>}}",
    passing="""meshes: {main: {bssid: "02:ca:fe:00:00:01"}}""",
)
def bssid_missing(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.mode is MeshMode.ADHOC and not mesh.bssid:
            yield Finding(("meshes", mesh.name), "no fixed BSSID", "a `bssid` such as 02:ca:fe:00:00:01", "none")


@fleet_rule(
    "MC304",
    Severity.ERROR,
    "Two meshes share a cell",
    why="""With the same BSSID, or the same SSID on one channel, the radios of both meshes join one cell with two sets
    of routing messages. Meshes at different sites do not hear each other.""",
    fix="Give each mesh a unique SSID and BSSID, or set the `site` of their nodes.",
    failing=second_mesh("other", "02:ca:fe:00:00:01", 11),
    passing=second_mesh("other", "02:ca:fe:00:00:02", 11),
)
def cell_shared(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    reported: set[str] = set()
    for meshes in meshes_in_earshot(fleet):
        for bssid, sharing in duplicates(((mesh.band, mesh.bssid), mesh) for mesh in meshes if mesh.bssid):
            for mesh in sharing[1:]:
                if mesh.name not in reported:
                    reported.add(mesh.name)
                    message = f"mesh {sharing[0].name} has the same BSSID"
                    yield Finding(("meshes", mesh.name, "bssid"), message, "a unique BSSID", bssid[1])
        for ssid, sharing in duplicates(((mesh.band, mesh.channel, mesh.ssid), mesh) for mesh in meshes):
            for mesh in sharing[1:]:
                if mesh.name not in reported:
                    reported.add(mesh.name)
                    message = f"mesh {sharing[0].name} has the same SSID on the same channel"
                    yield Finding(("meshes", mesh.name, "ssid"), message, "a unique SSID", ssid[2])


def meshes_in_earshot(fleet: Fleet) -> list[list[Mesh]]:
    """The meshes that may hear each other: those of each site, with those that are not at one site alone."""
    sites = {mesh.name: {node.site for node in fleet.members(mesh.name)} for mesh in fleet.meshes.values()}
    places = sorted({site for found in sites.values() for site in found if site})
    anywhere = {name for name, found in sites.items() if not found or "" in found}
    return [
        [mesh for mesh in fleet.meshes.values() if mesh.name in anywhere or place in sites[mesh.name]]
        for place in places or [""]
    ]


@fleet_rule(
    "MC305",
    Severity.WARNING,
    "Two meshes overlap in frequency",
    why="""Cells on overlapping channels cannot coordinate as they would on the same channel: each sees the other as
    noise and loses airtime. Meshes at different sites do not hear each other.""",
    fix="Use non-overlapping channels (1, 6 and 11 at 2.4 GHz), or another band; or set the `site` of their nodes.",
    failing=second_mesh("other", "02:ca:fe:00:00:02", 9),
    passing=second_mesh("other", "02:ca:fe:00:00:02", 11),
)
def cells_overlap(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    reported: set[str] = set()
    for meshes in meshes_in_earshot(fleet):
        for mesh, finding in _overlaps(meshes):
            if mesh not in reported:
                reported.add(mesh)
                yield finding


def _overlaps(meshes: Iterable[Mesh]) -> Iterator[tuple[str, Finding]]:
    spans = []
    for mesh in meshes:
        try:
            span = occupied_span(mesh.band, mesh.channel, mesh.htmode)
        except ValueError:
            continue
        if span is not None:
            spans.append((span, mesh))
    spans.sort(key=lambda pair: pair[0].low_mhz)
    if not spans:
        return
    # sorted by lower edge: a cell overlaps either the one with the highest upper edge so far or none
    reaching, first = spans[0]
    for span, mesh in spans[1:]:
        if span.overlaps(reaching) and (mesh.ssid, mesh.channel) != (first.ssid, first.channel):
            message = f"overlaps mesh {first.name} on {reaching.low_mhz}-{reaching.high_mhz} MHz"
            found = f"{span.low_mhz}-{span.high_mhz} MHz"
            yield mesh.name, Finding(("meshes", mesh.name, "channel"), message, "a non-overlapping channel", found)
        if span.high_mhz > reaching.high_mhz:
            reaching, first = span, mesh


@fleet_rule(
    "MC306",
    Severity.ERROR,
    "A radio joins a mesh of another band",
    why="A 5 GHz radio cannot tune to 2.4 GHz: the interface does not come up.",
    fix="Use a radio of the mesh's band, or correct the hardware profile's `band`.",
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
    "Two radios of one node are on the same channel of one mesh",
    why="""Two radios in one box desensitize each other when either transmits, and the mesh sees every message twice. A
    second radio helps only on another channel.""",
    fix="Leave one radio off, or assign it to a mesh on another channel.",
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
            yield Finding(path, f"{radios[0]} joins the same cell", f"one radio in {name}", join_limited(radios))


@fleet_rule(
    "MC308",
    Severity.ERROR,
    "The SSID is longer than 32 bytes",
    why="""IEEE 802.11 limits an SSID to 32 octets; the driver rejects a longer one and the radio stays off. Non-ASCII
    characters take several octets.""",
    fix="Shorten the SSID.",
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
    "The SSID has leading or trailing spaces",
    why="The space is invisible, and a laptop that joins by a typed name does not find the cell.",
    fix="Remove the space.",
    failing="""meshes: {main: {ssid: "fleet "}}""",
    passing="""meshes: {main: {ssid: "fleet 1"}}""",
)
def ssid_spaces(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.ssid != mesh.ssid.strip():
            yield Finding(
                ("meshes", mesh.name, "ssid"),
                "leading or trailing space",
                "no leading or trailing space",
                repr(mesh.ssid),
            )


@fleet_rule(
    "MC310",
    Severity.ERROR,
    "An apostrophe in the SSID breaks OpenWrt 25.12",
    why="""The wifi scripts of 25.12 put the SSID in single quotes on a shell command line. An apostrophe ends the
    quoting: the interface does not come up, and the rest is executed.""",
    fix="Use an SSID without an apostrophe.",
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
    why="""Mixed releases interoperate, but each has its own batman-adv and drivers: a test on one release does not
    cover the mixture.""",
    fix="Upgrade the older nodes when possible.",
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
            yield Finding(("meshes", mesh), "members run different releases", "one release", found)


@fleet_rule(
    "MC312",
    Severity.WARNING,
    "Ad-hoc mode on OpenWrt 19.07",
    why="""ath9k's ad-hoc mode under batman-adv has known faults on 19.07 (lime-packages#855): nodes stay in the cell
    but pass no traffic.""",
    fix="Upgrade these nodes, or set `mode: mesh`.",
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
            message = "ad-hoc mode is unreliable on 19.07"
            yield Finding(("meshes", mesh.name, "mode"), message, "21.02 or later, or mode mesh", join_limited(old))


@fleet_rule(
    "MC313",
    Severity.ERROR,
    "The multicast rate is not valid for the band",
    why="The driver rejects the rate and the interface does not come up, or it falls back to the lowest rate.",
    fix="Use 6000, 9000, 12000, 18000, 24000, 36000, 48000 or 54000 (also 1000, 2000, 5500, 11000 at 2.4 GHz).",
    failing="meshes: {main: {mcast_rate_kbps: 13000}}",
    passing="meshes: {main: {mcast_rate_kbps: 12000}}",
)
def broadcast_rate_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        rates = OFDM_KBPS if mesh.band is Band.G5 else tuple(sorted(_DSSS_KBPS + OFDM_KBPS))
        if mesh.mcast_rate_kbps not in rates:
            path, expected = ("meshes", mesh.name, "mcast_rate_kbps"), f"one of {', '.join(map(str, rates))}"
            yield Finding(path, "not a rate of this band", expected, str(mesh.mcast_rate_kbps))


@fleet_rule(
    "MC314",
    Severity.WARNING,
    "The multicast rate is low",
    why="""Originator messages at 1 Mbit/s reach much farther than data: BATMAN_IV then prefers one long weak link over
    two good ones, and every broadcast takes twelve times the airtime.""",
    fix="Set `mcast_rate_kbps` to 12000, or 6000 for long open links.",
    failing="meshes: {main: {mcast_rate_kbps: 1000}}",
    passing="meshes: {main: {mcast_rate_kbps: 6000}}",
)
def broadcast_rate_low(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.mcast_rate_kbps in _DSSS_KBPS and mesh.band is Band.G2 and mesh.mcast_rate_kbps < OFDM_KBPS[0]:
            path = ("meshes", mesh.name, "mcast_rate_kbps")
            yield Finding(path, "favors long weak links", "at least 6000", str(mesh.mcast_rate_kbps))


@fleet_rule(
    "MC315",
    Severity.WARNING,
    "`distance_m` is too short",
    why="""A radio ignores acknowledgments that arrive later than `distance_m` allows and retransmits delivered frames:
    longer links lose nearly all their throughput.""",
    fix="Set `distance_m` to the longest expected link; a few hundred extra meters cost almost nothing.",
    failing="meshes: {main: {distance_m: 50}}",
    passing="meshes: {main: {distance_m: 500}}",
)
def distance_short(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # the kernel rounds to coverage classes of 450 m (IEEE 802.11-2020 9.4.2.8: 3 us of propagation)
    for mesh in fleet.meshes.values():
        if mesh.distance_m < 100:
            path = ("meshes", mesh.name, "distance_m")
            yield Finding(path, "longer links fail", "the longest link, at least 100", str(mesh.distance_m))


@fleet_rule(
    "MC316",
    Severity.WARNING,
    "`distance_m` is very long",
    why="""After each lost frame the radio waits for the acknowledgment timeout before it retransmits: 30 km cost 200
    microseconds each time, for every node of the cell.""",
    fix="Set `distance_m` to the longest expected link.",
    failing="meshes: {main: {distance_m: 60000}}",
    passing="meshes: {main: {distance_m: 3000}}",
)
def distance_long(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.distance_m > 30_000:
            path = ("meshes", mesh.name, "distance_m")
            yield Finding(path, "every retransmission waits for this distance", "at most 30000", str(mesh.distance_m))


@fleet_rule(
    "MC317",
    Severity.WARNING,
    "The beacon interval is unusual",
    why="Short intervals fill the channel with beacons; long ones delay a node that joins the cell by seconds.",
    fix="Use 100, the usual value.",
    failing="meshes: {main: {beacon_interval_tu: 2000}}",
    passing="meshes: {main: {beacon_interval_tu: 100}}",
)
def beacon_interval(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if not 50 <= mesh.beacon_interval_tu <= 1000:
            path = ("meshes", mesh.name, "beacon_interval_tu")
            yield Finding(path, "beacons too frequent or too rare", "50 to 1000", str(mesh.beacon_interval_tu))
