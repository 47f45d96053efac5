"""Policy of changes: how many nodes at once, canary, quorum, when to stop, radar detection, spares (MC613 to MC621)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import PurePath

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Fleet, Mesh, MeshMode, NodeState
from meshctl.regdb import CHANNELS, Country, DfsRegion, Flag, Span, check_span, occupied_span, primary_span
from meshctl.resolve import package_files, package_needs, package_plan
from meshctl.wording import join_limited, one_of

# Radar detection before the first frame on a channel (channel availability check): the kernel's minimum, and that of
# ETSI EN 301 893 where the channel overlaps weather radar.
_CAC_S, _WEATHER_CAC_S = 60, 600
_WEATHER_MHZ = (5600, 5650)
# A mesh change decides after three quarters of the window (`meshctl.apply.mesh_commit`). The reload and the meeting of
# the nodes get as much of that as the default window of 120 s leaves them where there is no radar.
_DECISION_SHARE = 0.75
_MEETING_S = 90


@fleet_rule(
    "MC613",
    Severity.WARNING,
    "Most of a mesh may be down at once",
    why="""With more than half of the nodes down at the same time, a bad change takes down the mesh and the way to
    repair it.""",
    fix="Lower `apply.max_down`: 1 is safe, a fifth of the mesh is usual.",
    failing="apply: {max_down: 3}",
    passing="apply: {max_down: 1}",
)
def max_down_large(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    sizes = group_by_key((mesh, node.name) for node in fleet.managed() for mesh in node.meshes)
    mesh, names = min(sizes.items(), key=lambda item: len(item[1]), default=("", []))
    limit = max(len(names) // 2, 1)
    if len(names) > 1 and fleet.apply.max_down > limit:
        message = f"a bad change takes down most of mesh {mesh}, which has {len(names)} nodes"
        yield Finding(("apply", "max_down"), message, f"at most {limit}", str(fleet.apply.max_down))


@fleet_rule(
    "MC614",
    Severity.WARNING,
    "Changes are rolled out without a canary",
    why="Without a canary, a mistake reaches many nodes before the first one shows it.",
    fix="Set `apply.canary: true`.",
    failing="apply: {canary: false}",
    passing="apply: {canary: true}",
)
def no_canary(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if not fleet.apply.canary and sum(1 for _ in fleet.managed()) > 1:
        yield Finding(("apply", "canary"), "a mistake reaches many nodes at once", "true", "false")


@fleet_rule(
    "MC615",
    Severity.WARNING,
    "The quorum is not more than one half",
    why="""A change of the whole cell is kept when the quorum rejoins. At one half or less, a split mesh counts as
    success, and its parts may keep different configurations.""",
    fix="Set `apply.quorum` to 0.6 or more.",
    failing="apply: {quorum: 0.4}",
    passing="apply: {quorum: 0.8}",
)
def quorum_low(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if fleet.apply.quorum <= 0.5:
        expected, found = "more than 0.5", f"{fleet.apply.quorum:g}"
        yield Finding(("apply", "quorum"), "a split mesh would count as success", expected, found)


@fleet_rule(
    "MC616",
    Severity.WARNING,
    "A run continues after many failures",
    why="""After the first failures, further ones of the same kind add no information, but each failed node has to be
    repaired by hand.""",
    fix="Set `apply.stop_after_failures` to 1 or 2.",
    failing="apply: {stop_after_failures: 10}",
    passing="apply: {stop_after_failures: 2}",
)
def stops_late(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if fleet.apply.stop_after_failures > 5:
        found = str(fleet.apply.stop_after_failures)
        yield Finding(("apply", "stop_after_failures"), "many nodes fail before the run stops", "at most 5", found)


@fleet_rule(
    "MC620",
    Severity.ERROR,
    "The confirm window is too short for radar detection",
    why="""On a DFS channel a radio listens for radar for a minute before it transmits, in Europe for ten minutes on
    5600 to 5650 MHz (channels 120 to 128). The nodes of a changed mesh do not meet before that, so a good change is
    rolled back, and the way back may need radar detection, too.""",
    fix="Set `confirm_window_s` to 200, or to 920 where weather radar is, or choose a channel without DFS.",
    failing=Example(
        """
        meshes: {main: {band: 5g, channel: 52, mode: mesh, encryption: sae}}
        defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
        """,
        also=("MC325",),
    ),
    passing=Example(
        """
        meshes: {main: {band: 5g, channel: 52, mode: mesh, encryption: sae}}
        defaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}
        hardware: {rocket: {confirm_window_s: 200}}
        """,
        also=("MC325",),
    ),
)
def window_without_radar_detection(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    country = context.regdb.country(fleet.country)
    if country is None:
        return
    detection_s = {
        name: seconds for name, mesh in fleet.meshes.items() if (seconds := _radar_detection_s(mesh, country))
    }
    found: set[tuple[str, ...]] = set()
    for node in fleet.managed():
        longest_s = max((detection_s.get(mesh, 0) for mesh in node.meshes), default=0)
        path = ("nodes", node.name, "confirm_window_s")
        if node.confirm_window_s == node.hardware.confirm_window_s:
            path = ("hardware", node.hardware.name, "confirm_window_s")
        needed_s = round((longest_s + _MEETING_S) / _DECISION_SHARE)
        if longest_s and node.confirm_window_s < needed_s and path not in found:
            found.add(path)
            expected = f"at least {needed_s} s, {longest_s} of them for radar detection"
            yield Finding(path, "too short for radar detection", expected, f"{node.confirm_window_s} s")


def _radar_detection_s(mesh: Mesh, country: Country) -> int:
    """How long a radio of the mesh listens before it transmits; 0 on a channel without DFS, and for ad-hoc cells, which
    cannot use one at all (MC324)."""
    if mesh.mode is not MeshMode.MESH or mesh.channel not in CHANNELS[mesh.band]:
        return 0
    span = _span(mesh)
    verdict = check_span(country, span)
    if not verdict.covered or Flag.DFS not in verdict.flags:
        return 0
    low_mhz, high_mhz = _WEATHER_MHZ
    has_weather_radar = span.low_mhz < high_mhz and span.high_mhz > low_mhz
    return _WEATHER_CAC_S if has_weather_radar and country.dfs_region is DfsRegion.ETSI else _CAC_S


def _span(mesh: Mesh) -> Span:
    """The frequencies that the mesh occupies, or its primary channel if other rules report the width (MC327, MC329)."""
    try:
        occupied = occupied_span(mesh.band, mesh.channel, mesh.htmode)
    except ValueError:
        occupied = None
    return occupied or primary_span(mesh.band, mesh.channel)


@fleet_rule(
    "MC621",
    Severity.NOTE,
    "A spare lacks a package of nodes that it may replace",
    why="""A spare's image has the packages of the spare's own entry. `meshctl replace` refuses it for a node of the
    same hardware that needs another one, such as `kmod-nft-bridge` for a LAN filter, in the field.""",
    fix="""List the package in the hardware profile, which all of its nodes share, or bring it as one of
    `package_files`.""",
    failing="nodes: {husky1-front: {lan_filter: {}}, s01: {address: 10.42.0.150, label: S1}}",
    passing="""
    hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, kmod-nft-bridge]}}
    nodes: {husky1-front: {lan_filter: {}}, s01: {address: 10.42.0.150, label: S1}}
    """,
)
def spare_lacks_packages(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    known = [node for node in fleet.managed() if all(name in fleet.meshes for name in node.meshes)]
    for spare in (node for node in known if node.state is NodeState.SPARE):
        like = [node for node in known if (node.hardware, node.release) == (spare.hardware, spare.release)]
        has = package_plan(fleet, spare).install
        brought = tuple(PurePath(file).name for file in package_files(fleet, spare))
        needed = ((need.any_of, node.name) for node in like for need in package_needs(fleet, node))
        for any_of, names in group_by_key(needed).items():
            if (
                spare.name not in names
                and not set(has).intersection(any_of)
                and not any(file.startswith(any_of) for file in brought)
            ):
                message = f"cannot replace {join_limited(names)}"
                yield Finding(("nodes", spare.name), message, one_of(any_of), "none of them")
