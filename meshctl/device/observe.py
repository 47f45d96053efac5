"""Observe a node: run scripts/observe.sh there and parse the sections it prints into an `Observation`.

`observe` is the round trip; `interpret` is pure. Parsers do not raise: what they cannot read becomes None and a note.
"""

from __future__ import annotations

import hashlib
import secrets
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from types import MappingProxyType
from typing import TypeVar

from meshctl.device.connection import Connection, KeepingConnection
from meshctl.device.framing import quoted
from meshctl.device.observation import (
    BoardInfo,
    ChangeStatus,
    ChannelSurvey,
    FileInfo,
    MeshInfo,
    MeshNeighbor,
    MeshTableSizes,
    Observation,
    Originator,
    RadioChip,
    ReleaseInfo,
    Space,
    Station,
    WirelessLink,
)
from meshctl.device.parse import batctl, iw, keys, nft, packages, system, ubus
from meshctl.device.parse.deadman import parse_status
from meshctl.device.parse.sections import OutputSection, split_sections
from meshctl.device.scripts import code

T = TypeVar("T")

# A busy ath79 takes about ten seconds for all of it; a lossy path of five hops adds its own.
OBSERVE_TIMEOUT_S = 90.0


@dataclass(frozen=True, slots=True)
class RawObservation:
    """Output of observe.sh on a node, before it is parsed: sections between lines with `nonce`."""

    nonce: str
    output: bytes = field(repr=False)
    asked_at_s: float
    answered_at_s: float

    def interpret(self) -> Observation:
        sections = split_sections(self.output, self.nonce)
        return interpret(sections, asked_at_s=self.asked_at_s, answered_at_s=self.answered_at_s)


def observe_again(
    connection: KeepingConnection,
    *,
    extra_paths: Iterable[str] = (),
    timeout_s: float = OBSERVE_TIMEOUT_S,
    clock: Callable[[], float] = time.time,
) -> RawObservation:
    """One round trip for everything about the node, for those who look at it again and again: it keeps the script, and
    of a long table of originators it sends the rows of neighbors alone. `extra_paths` are further files to read. Raises
    Timeout and ConnectionLost."""
    nonce = _nonce()
    asked = clock()
    done = connection.run_kept(_kept_script(), (nonce, *_checked(extra_paths)), timeout_s=timeout_s)
    return RawObservation(nonce, done.stdout_bytes, asked, clock())


def observe(
    connection: Connection,
    *,
    extra_paths: Iterable[str] = (),
    brief: bool = False,
    timeout_s: float = OBSERVE_TIMEOUT_S,
    clock: Callable[[], float] = time.time,
) -> Observation:
    """One round trip for everything about the node, parsed; a missing or unreadable answer is data. `extra_paths` are
    further files to read; `brief` leaves out what no proof of a change needs. Raises Timeout and ConnectionLost."""
    nonce = _nonce()
    asked = clock()
    done = connection.run(observation_script(nonce, extra_paths, brief=brief), timeout_s=timeout_s)
    return RawObservation(nonce, done.stdout_bytes, asked, clock()).interpret()


def observation_script(nonce: str, extra_paths: Iterable[str] = (), *, brief: bool = False) -> str:
    """observe.sh with its inputs set. Raises ValueError for a path with blanks or quotes."""
    values = {"N": nonce, "EXTRA": " ".join(_checked(extra_paths)), "BRIEF": "yes" if brief else "", "NEAR": ""}
    return "\n".join([*(f"{name}={quoted(value)}" for name, value in values.items()), code("observe.sh")])


@cache
def _kept_script() -> str:
    """observe.sh with its inputs as arguments: the nonce and the further paths."""
    return f'N=$1\nshift\nEXTRA="$*"\nBRIEF=\nNEAR=yes\n{code("observe.sh")}'


def _nonce() -> str:
    return f"meshctl-{secrets.token_hex(16)}"


def _checked(extra_paths: Iterable[str]) -> tuple[str, ...]:
    paths = tuple(extra_paths)
    for path in paths:
        if not path.startswith("/") or quoted(path) != path:
            raise ValueError(f"{path!r}: expected an absolute path of letters, digits and ._+@%:,-")
    return paths


class _OutputReader:
    """Sections by name; adds a note for each one that is missing, failed or unparsable."""

    def __init__(self, sections: Mapping[str, OutputSection]) -> None:
        self._sections = sections
        self.notes: list[str] = []
        if "done" not in sections:
            self.notes.append("the observation was cut short")

    def read(self, name: str, parse: Callable[[str], T | None], *, required: bool = True) -> T | None:
        """Parse a section, or return None; an empty section of a failed tool is not parsed."""
        section = self._sections.get(name)
        if section is None:
            if required:
                self.notes.append(f"{name}: not reported")
            return None
        if section.status != 0 and not section.body.strip():
            if required:
                self.notes.append(f"{name}: exit status {section.status}")
            return None
        value = parse(section.text)
        if value is None:
            self.notes.append(f"{name}: not understood: {section.text.strip()[:60]!r}")
        return value

    def names(self, kind: str) -> list[str]:
        """The second words of the sections `KIND WORD`."""
        return [name.split(" ", 1)[1] for name in self._sections if name.startswith(f"{kind} ")]

    def found_nothing(self, name: str) -> bool:
        """Whether a section's command failed without output, as `command -v` does."""
        section = self._sections.get(name)
        return section is not None and section.status > 0 and not section.body.strip()

    def body(self, name: str) -> bytes | None:
        section = self._sections.get(name)
        return None if section is None or section.status != 0 else section.body

    def status(self, name: str) -> int | None:
        section = self._sections.get(name)
        return None if section is None else section.status


def interpret(sections: Mapping[str, OutputSection], *, asked_at_s: float, answered_at_s: float) -> Observation:
    """The sections of observe.sh as facts. Pure; any input gives an Observation."""
    reader = _OutputReader(sections)
    board, release = _board(reader)
    space = reader.read("df", system.parse_df) or {}
    links, stations, surveys = _wireless(reader)
    mesh, neighbors, originators, tables = _mesh(reader)
    macs = reader.read("macs", system.parse_macs)
    indexes = reader.read("macs", system.parse_indexes, required=False) or {}
    has_tool = not reader.found_nothing("package_tool")
    if not has_tool:
        reader.notes.append("no package manager: neither apk nor opkg was found")
    installed = reader.read("packages", packages.parse_packages, required=has_tool)
    return Observation(
        asked_at_s=asked_at_s,
        answered_at_s=answered_at_s,
        release=release,
        board=board,
        boot_id=reader.read("boot_id", system.parse_boot_id),
        uptime_s=reader.read("uptime", system.parse_uptime),
        clock_s=reader.read("clock", system.parse_clock),
        load=reader.read("load", system.parse_load),
        memory=reader.read("meminfo", system.parse_meminfo),
        overlay=_space(space, "/"),
        is_first_boot=reader.read("root", system.parse_first_boot, required=False),
        root_read_only=reader.read("root", system.parse_read_only_root, required=False),
        tmp=_space(space, "/tmp"),
        macs=None if macs is None else MappingProxyType(macs),
        ifindexes=MappingProxyType({name: index for index, name in indexes.items()}) if indexes else None,
        radios=reader.read("ubus.wireless", ubus.parse_wireless),
        links=links,
        chips=_chips(reader),
        stations=stations,
        surveys=surveys,
        sensors=reader.read("sensors", system.parse_sensors, required=False),
        supplicants=reader.read("supplicants", _supplicants, required=False),
        interfaces=reader.read("ubus.interfaces", ubus.parse_interfaces),
        bridges=reader.read("bridges", system.parse_bridges),
        lan_filter=reader.read("lan_filter", nft.parse_lan_filter, required=False),
        mesh=mesh,
        neighbors=neighbors,
        originators=originators,
        mesh_statistics=_statistics(reader),
        mesh_tables=tables,
        package_tool=reader.read("package_tool", packages.parse_package_tool, required=has_tool),
        packages=None if installed is None else MappingProxyType(installed),
        uci=_uci(reader),
        uci_changes=_lines(reader, "uci.changes"),
        unconfirmed_packages=reader.read("uci.unconfirmed", _words, required=False),
        authorized_keys=reader.read("authorized_keys", keys.parse_authorized_keys),
        host_keys=reader.read("host_keys", keys.parse_host_keys),
        files=MappingProxyType({path: _file(reader, path) for path in reader.names("mode")}),
        change=reader.read("deadman", _change),
        notes=tuple(reader.notes),
    )


def _board(reader: _OutputReader) -> tuple[BoardInfo | None, ReleaseInfo | None]:
    ubus_board, release = reader.read("ubus.board", ubus.parse_board) or (None, None)
    if release is None:
        release = reader.read("openwrt_release", system.parse_openwrt_release)
    board_name = (reader.read("board_name", str.strip, required=False) or "") or (
        ubus_board.board_name if ubus_board else ""
    )
    if not board_name and ubus_board is None:
        return None, release
    model = reader.read("model", str.strip, required=False) or ""
    written = reader.read("board.json", ubus.parse_board_json) or BoardInfo("")
    board = ubus_board or BoardInfo(board_name="")
    return replace(
        written,
        board_name=board_name,
        model=board.model or model,
        hostname=board.hostname,
        kernel=board.kernel,
    ), release


def _space(space: Mapping[str, Space], path: str) -> Space | None:
    """The file system mounted at `path`, or at / where `path` has none of its own."""
    return space.get(path) or space.get("/")


def _wireless(
    reader: _OutputReader,
) -> tuple[tuple[WirelessLink, ...] | None, tuple[Station, ...] | None, tuple[ChannelSurvey, ...] | None]:
    links = reader.read("iw.dev", iw.parse_iw_dev)
    if links is None:
        return None, None, None
    joined = tuple(iw.with_link(link, reader.read(f"iw.link {link.ifname}", str) or "") for link in links)
    stations: list[Station] = []
    for link in links:
        stations += reader.read(f"iw.stations {link.ifname}", iw.parse_stations) or ()
    surveys = [
        survey
        for name in reader.names("iw.survey")
        # some drivers have none, and a radio that is down is on no channel
        if (survey := iw.parse_survey((reader.body(f"iw.survey {name}") or b"").decode("utf-8", "replace")))
    ]
    return joined, tuple(stations), tuple(surveys) if reader.names("iw.survey") else None


def _chips(reader: _OutputReader) -> tuple[RadioChip, ...] | None:
    """The radios by either source; None if both are missing."""
    places = reader.read("phys", system.parse_phys, required=False) or {}
    able = {chip.phy: chip for chip in reader.read("iw.phy", iw.parse_phys, required=False) or ()}
    found = tuple(
        replace(able.get(phy, RadioChip(phy)), path=place[0], driver=place[1])
        for phy in sorted(places.keys() | able.keys())
        for place in (places.get(phy, ("", "")),)
    )
    return found or None


def _mesh(
    reader: _OutputReader,
) -> tuple[
    MeshInfo | None,
    tuple[MeshNeighbor, ...] | None,
    tuple[Originator, ...] | None,
    Mapping[str, MeshTableSizes] | None,
]:
    """Facts of all batman-adv interfaces together, and the sizes of each one's tables; all None without any."""
    names = reader.names("batctl.originators_json")
    if not names:
        return None, None, None, None
    info: MeshInfo | None = None
    hard: list[tuple[str, ...] | None] = []
    known = reader.read("macs", system.parse_indexes, required=False) or {}
    neighbors: list[MeshNeighbor] | None = None
    originators: list[Originator] | None = None
    tables: dict[str, MeshTableSizes] = {}
    for name in names:
        as_text = reader.status(f"batctl.originators {name}") is not None
        if as_text:
            header = reader.read(f"batctl.originators {name}", batctl.parse_mesh_header)
            near = reader.read(f"batctl.neighbors {name}", batctl.parse_neighbors_text)
            far = reader.read(f"batctl.originators {name}", batctl.parse_originators_text)
            hard.append(reader.read(f"batctl.interface {name}", batctl.parse_interfaces_text))
        else:
            header = reader.read(f"batctl.mesh_json {name}", batctl.parse_mesh_json)
            near = reader.read(f"batctl.neighbors_json {name}", lambda text: batctl.parse_neighbors_json(text, known))
            far = reader.read(
                f"batctl.originators_json {name}", lambda text: batctl.parse_originators_json(text, known)
            )
            hard.append(reader.read(f"batctl.hardifs_json {name}", lambda text: batctl.parse_hardifs_json(text, known)))
        info = info or header
        neighbors = (neighbors or []) + list(near) if near is not None else neighbors
        originators = (originators or []) + list(far) if far is not None else originators
        tables[name] = _table_sizes(
            far,
            reader.read(f"batctl.originators_count {name}", batctl.parse_originators_count, required=False),
            reader.read(f"batctl.transglobal {name}", batctl.parse_transglobal, required=False),
        )
    return (
        None if info is None else replace(info, hard_interfaces=_all(hard)),
        None if neighbors is None else tuple(neighbors),
        None if originators is None else tuple(originators),
        MappingProxyType(tables),
    )


def _all(lists: list[tuple[str, ...] | None]) -> tuple[str, ...] | None:
    """Every name once; None if one of the lists could not be read."""
    known = [names for names in lists if names is not None]
    return tuple(dict.fromkeys(name for names in known for name in names)) if len(known) == len(lists) else None


def _table_sizes(
    paths: tuple[Originator, ...] | None, counts: tuple[int, int] | None, translations: tuple[int, int] | None
) -> MeshTableSizes:
    """`counts` are those of the whole table, where `paths` are not all of it."""
    if counts is None and paths is not None:
        selected = sum(path.best for path in paths)
        counts = (selected, len(paths) - selected)
    return MeshTableSizes(*(counts or (None, None)), *(translations or (None, None)))


def _statistics(reader: _OutputReader) -> Mapping[str, Mapping[str, int]] | None:
    found = {
        name: counters
        for name in reader.names("batctl.statistics")
        if (counters := reader.read(f"batctl.statistics {name}", batctl.parse_statistics, required=False))
    }
    return MappingProxyType(found) if found else None


def _supplicants(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.removeprefix("wpa_supplicant.") for name in text.split()))


def _uci(reader: _OutputReader) -> Mapping[str, str] | None:
    if reader.body("config.list") is None:
        reader.notes.append("config.list: /etc/config cannot be read")
        return None
    bodies = {name: reader.body(f"config {name}") for name in reader.names("config")}
    return MappingProxyType(
        {name: body.decode("utf-8", "replace") for name, body in bodies.items() if body is not None}
    )


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


def _lines(reader: _OutputReader, name: str) -> tuple[str, ...] | None:
    body = reader.body(name)
    if body is None:
        reader.notes.append(f"{name}: exit status {reader.status(name)}")
        return None
    return tuple(line for line in body.decode("utf-8", "replace").splitlines() if line.strip())


def _file(reader: _OutputReader, path: str) -> FileInfo | None:
    """None for a path that does not exist or is not a regular file."""
    listed, hashed, text = (reader.body(f"{kind} {path}") for kind in ("mode", "hash", "text"))
    if listed is None or hashed is None or text is None:
        return None
    mode = system.parse_mode(listed.decode("utf-8", "replace"))
    digest = hashed.split()[:1]
    if mode is None or not digest:
        reader.notes.append(f"{path}: not understood: {listed[:60]!r}")
        return None
    return FileInfo(path=path, mode=mode, sha256=digest[0].decode("ascii", "replace"), text=_as_text(text, digest[0]))


def _as_text(body: bytes, digest: bytes) -> str | None:
    """The text, if it is UTF-8 and complete: the script truncates a long file, so its hash differs."""
    if hashlib.sha256(body).hexdigest().encode() != digest:
        return None
    try:
        return body.decode("utf-8")
    except UnicodeDecodeError:
        return None


def _change(text: str) -> ChangeStatus | None:
    return ChangeStatus(state="absent", installed=False) if text.strip() == "absent" else parse_status(text)
