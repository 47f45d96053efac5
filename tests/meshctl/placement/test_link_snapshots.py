"""From the tables of radios to a snapshot of the placement meter, and the command on a fleet whose robot moves."""

from __future__ import annotations

import socket
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.device.framing import quoted
from meshctl.device.link_table import LinkTable, links_script, parse_links
from meshctl.device.parse.sections import split_sections
from meshctl.nodes.link_snapshots import HopMargins, MeshTables, Rack, assemble, path_beyond
from meshctl.placement.meter import PathBeyond, RelayLink
from meshctl.robots.local_daemon import DaemonError, LocalDaemon

MACS = {name: f"02:00:00:00:00:{index:02x}" for index, name in enumerate(("base", "b01", "b02", "spot1"), 1)}
NAMES = {mac: name for name, mac in MACS.items()}
STATIONS = """Station {mac} (on mesh0)
\tinactive time:\t{inactive} ms
\tsignal:  \t{signal} [-60, -62] dBm
\tsignal avg:\t-50 [-50, -52] dBm
\texpected throughput:\t39.0Mbps
"""
SURVEY = "Survey data from mesh0\n\tfrequency:\t\t\t2437 MHz [in use]\n\tnoise:\t\t\t\t-92 dBm\n"
PATHS = """[B.A.T.M.A.N. adv 2023.1, MainIF/MAC: mesh0/02:00:00:00:00:04 (bat0/02:00:00:00:01:04 BATMAN_IV)]
   Originator        last-seen (#/255) Nexthop           [outgoingIF]
   02:00:00:00:00:01    0.480s   (150) 02:00:00:00:00:03 [     mesh0]
 * 02:00:00:00:00:01    0.480s   (210) 02:00:00:00:00:02 [     mesh0]
"""


def table(taken_s: float = 0.0, next_hop: str = "", **signals: int) -> LinkTable:
    macs = {MACS[name]: dbm for name, dbm in signals.items()}
    return LinkTable(taken_s, macs, dict.fromkeys(macs, -95), MACS.get(next_hop, ""))


def mesh(**tables: LinkTable) -> MeshTables:
    return MeshTables(tables, NAMES, ("spot1",), "base")


def test_the_output_of_a_radio_is_a_table_of_fresh_stations_and_the_next_hop() -> None:
    nonce = "N0"
    sections = {
        "iw.stations mesh0": STATIONS.format(mac=MACS["b01"].upper(), inactive=120, signal=-61)
        + STATIONS.format(mac=MACS["b02"], inactive=9000, signal=-70),
        "iw.survey mesh0": SURVEY,
        "batctl.path bat0": PATHS,
        "done": "",
    }
    output = "".join(f"{nonce} begin {name}\n{body}\n{nonce} end 0\n" for name, body in sections.items()).encode()
    found = parse_links(split_sections(output, nonce), [MACS["base"].upper()], taken_s=5.0)
    assert replace(found, paths=None) == LinkTable(
        5.0, {MACS["b01"]: -61}, {MACS["b01"]: -92}, MACS["b01"], {MACS["b01"]: 39.0}
    )
    assert [(row.next_hop, row.best, row.tq) for row in found.paths or ()] == [
        (MACS["b02"], False, 150),
        (MACS["b01"], True, 210),
    ]
    assert parse_links({}, [MACS["base"]], taken_s=5.0) == LinkTable(5.0, {}, {}, "")


@pytest.mark.parametrize(("state", "is_link"), [("ESTAB", True), ("BLOCKED", False), ("LISTEN", False)])
def test_a_mesh_peer_is_a_link_once_it_is_established(state: str, is_link: bool) -> None:
    nonce = "meshctl-00"
    station = STATIONS.format(mac=MACS["b01"], inactive=40, signal=-61) + f"\tmesh plink:\t{state}\n"
    output = f"{nonce} begin iw.stations mesh0\n{station}\n{nonce} end 0\n".encode()
    found = parse_links(split_sections(output, nonce), [], taken_s=5.0)
    assert found.signals_dbm == ({MACS["b01"]: -61} if is_link else {})
    assert "|mesh plink:'" in links_script(nonce, [])


def test_the_script_takes_no_word_that_a_shell_would_run() -> None:
    text = links_script("meshctl-1", [MACS["base"], "$(reboot)", "02:00:00:00:00:09"])
    assert f"ROWS={quoted('^[ *]*(02:00:00:00:00:01|02:00:00:00:00:09) ')}" in text
    assert "reboot" not in text


def test_a_look_has_both_directions_and_the_hops_behind() -> None:
    seen = mesh(
        spot1=table(10.0, "b01", b01=-70, b02=-80),
        b01=table(9.0, "base", spot1=-74, base=-60),
        base=table(9.0, b01=-66),
        b02=table(9.0, "spot1", spot1=-81),
    )
    snapshot = assemble(seen, HopMargins(7.0), 10.0, fresh=True, beacons=2)
    assert snapshot.links == (RelayLink("b01", -70, -95, -74, -95), RelayLink("b02", -80, -95, -81, -95))
    assert snapshot.next_hop == "b01"
    # b02 reaches the base through the robot alone: no relay for it
    assert set(snapshot.paths) == {"b01"}
    assert snapshot.paths["b01"] == PathBeyond(1, 29.0 - 7.0 - 10.0, 29.0)
    # the same table gives no second sample
    assert assemble(seen, HopMargins(7.0), 11.0, fresh=False).links == ()


def test_a_relay_that_was_not_asked_yet_counts_as_one_hop() -> None:
    seen = mesh(spot1=table(0.0, "b01", b01=-70))
    assert path_beyond(seen, HopMargins(7.0), "b01") == PathBeyond(1)
    assert path_beyond(seen, HopMargins(7.0), "base") == PathBeyond(0)


def test_what_is_in_the_rack_is_no_relay() -> None:
    """b01 is on in spot1's rack, and spot1's traffic goes through it to the base."""
    seen = mesh(
        spot1=table(10.0, "b01", b01=-30, b02=-80, base=-88),
        b01=table(9.0, "base", spot1=-30, base=-87),
        b02=table(9.0, "b01", spot1=-81, b01=-80),
    )
    snapshot = assemble(replace(seen, aboard=frozenset({"b01"})), HopMargins(7.0), 10.0, fresh=True)
    assert {link.relay for link in snapshot.links} == {"base", "b02"}
    # b02 reaches the base through the rack alone
    assert set(snapshot.paths) == {"base"}
    assert snapshot.next_hop == ""


def test_a_beacon_leaves_the_rack_when_it_is_marked_or_heard_weakly() -> None:
    rack = Rack()
    assert rack.aboard({}, {"b01", "b02", "b03"}) == frozenset()
    assert rack.aboard({"b01": -30, "b02": -35, "b03": -75, "base": -40}, {"b01", "b02", "b03"}) == {"b01", "b02"}
    # fading, and one snapshot without it
    assert rack.aboard({"b01": -44, "b02": -31}, {"b01", "b02", "b03"}) == {"b01", "b02"}
    assert rack.aboard({"b02": -45}, {"b01", "b02", "b03"}) == {"b01", "b02"}
    # dropped: b01 is behind the robot, b02 is marked beside it
    assert rack.aboard({"b01": -46, "b02": -45}, {"b01", "b02", "b03"}) == {"b02"}
    assert rack.aboard({"b01": -30, "b02": -45}, {"b01", "b03"}) == frozenset()
    # one that is switched on as it is dropped is a relay at once
    assert rack.aboard({"b01": -30, "b02": -45, "b03": -30}, {"b01", "b03"}) == frozenset()


def test_next_hops_in_a_circle_are_no_path() -> None:
    seen = mesh(b01=table(0.0, "b02", b02=-60), b02=table(0.0, "b01", b01=-60))
    assert path_beyond(seen, HopMargins(7.0), "b01") is None


@pytest.mark.parametrize(
    ("reply", "complaint"),
    [
        (b"\0\0\0\x0c\0\0\0\0" + b'{"ok": 7, ]}', "Expecting"),
        (b"\xff\xff\xff\xff\0\0\0\0", "a reply of 4294967295 bytes"),
        (b"\0\0\0\x20\0\0\0\0" + b'{"ok": false, "error": "too big"}'[:32], "Expecting"),
        (b"", "the daemon closed the connection"),
    ],
)
def test_a_daemon_that_answers_nonsense_is_an_error(tmp_path: Path, reply: bytes, complaint: str) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        server.listen()

        def answer() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(1000)
                connection.sendall(reply)

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(DaemonError) as caught:
            LocalDaemon(tmp_path / "s").request("status")
        thread.join(10)
    assert complaint in str(caught.value)
    with pytest.raises(DaemonError, match=f"^{tmp_path / 'none'}: No such file or directory$"):
        LocalDaemon(tmp_path / "none").request("status")
