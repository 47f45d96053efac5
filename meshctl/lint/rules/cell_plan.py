"""Rules about the names of cells and the reach of their multicasts (MC318 to MC319)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.cell import OFDM_KBPS, meshes_in_earshot, second_mesh
from meshctl.model import Fleet

# receivers need -79 dBm for 12 Mbit/s, -74 for 24, and -65 for 54 (IEEE 802.11-2020 17.3.10.2)
_HIGHEST_USUAL_KBPS = 24000


@fleet_rule(
    "MC318",
    Severity.WARNING,
    "The multicast rate is high",
    why="""Routing messages are sent at this rate, and the radio does not retransmit them. 54 Mbit/s needs a signal
    14 dB stronger than 12 Mbit/s, so only radios at a fifth of the distance hear them: a node that unicast frames would
    still reach at a lower rate is no neighbor, and is not reachable.""",
    fix="Set `mcast_rate_kbps` to 12000; 18000 or 24000 only where every node has a strong signal.",
    failing="meshes: {main: {mcast_rate_kbps: 54000}}",
    passing="meshes: {main: {mcast_rate_kbps: 24000}}",
)
def broadcast_rate_high(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.mcast_rate_kbps in OFDM_KBPS and mesh.mcast_rate_kbps > _HIGHEST_USUAL_KBPS:
            path = ("meshes", mesh.name, "mcast_rate_kbps")
            expected = f"6000 to {_HIGHEST_USUAL_KBPS}"
            yield Finding(path, "only the nearest nodes become neighbors", expected, str(mesh.mcast_rate_kbps))


@fleet_rule(
    "MC319",
    Severity.WARNING,
    "Two networks have meshes with the same SSID",
    why="""Their channels alone keep them apart. In a scan they look alike, `meshctl inventory
    import` takes the first one, and once one moves to the other's channel, their radios join one cell with two
    networks. Meshes of one network, or at different sites, may share a name.""",
    fix="Give each mesh a name of its own, or set the `site` of their nodes.",
    failing=second_mesh("fleet", "02:ca:fe:00:00:02", 11),
    passing=second_mesh("other", "02:ca:fe:00:00:02", 11),
)
def ssid_of_two_networks(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    reported: set[str] = set()
    for meshes in meshes_in_earshot(fleet):
        for (_, _, ssid), sharing in duplicates(((mesh.band, mesh.mode, mesh.ssid), mesh) for mesh in meshes):
            first = sharing[0]
            for mesh in sharing[1:]:
                # MC304 reports those on one channel
                is_apart = mesh.channel != first.channel and mesh.network != first.network
                if is_apart and mesh.name not in reported:
                    reported.add(mesh.name)
                    message = f"mesh {first.name} has the same SSID on channel {first.channel}"
                    yield Finding(("meshes", mesh.name, "ssid"), message, "a unique SSID", ssid)
