"""Encrypted meshes of the kernel's radios, and a node with two: WPA2 in an ad-hoc cell, SAE in 802.11s."""

from __future__ import annotations

import json

import pytest

from meshlab.qemu import control
from tests.meshlab.qemu.conftest import until
from tests.meshlab.qemu.team.conftest import FIELDED, KEYS, Team

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab-real-team"), pytest.mark.timeout(1800)]

TWINS = ("b02", "husky")
# data frames in ten seconds: the number of encrypted ones, and of unencrypted ones except handshakes
_LISTEN = """
ip link set hwsim0 up
cat >/tmp/protected.py <<'END'
import socket, time
air = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
air.bind(("hwsim0", 0))
air.settimeout(1)
end, protected, clear = time.monotonic() + 10, 0, 0
while time.monotonic() < end:
    try:
        frame = air.recv(4096)
    except TimeoutError:
        continue
    body = frame[int.from_bytes(frame[2:4], "little"):]
    if len(body) < 24 or (body[0] >> 2) & 3 != 2 or body[0] & 0x40:
        continue
    if body[1] & 0x40:
        protected += 1
    elif b"\\xaa\\xaa\\x03\\0\\0\\0\\x88\\x8e" not in body[24:44]:
        clear += 1
print(protected, clear)
END
python3 /tmp/protected.py
"""


def heard_over(team: Team, name: str) -> dict[str, set[str]]:
    """The neighbors that each of the node's radios has heard within the last seconds, from its batman-adv."""
    names = team.names()
    found: dict[str, set[str]] = {"mesh0": set(), "mesh1": set()}
    for one in json.loads(team.on(name, "batctl meshif bat0 neighbors_json")):
        if one["last_seen_msecs"] < 5000:
            found[one["hard_ifname"]].add(names[one["neigh_address"]])
    return found


def keys(team: Team) -> dict[str, set[str]]:
    """The configured keys of the nodes' radios, by mesh."""
    words = "uci -q get wireless.mesh0.key; echo; uci -q get wireless.mesh1.key || true"
    outputs = [team.on(name, words).split("\n") for name in FIELDED]
    return {"main": {lines[0] for lines in outputs}, "fast": {lines[2] for lines in outputs if lines[2:] and lines[2]}}


def all_authorized(team: Team) -> bool:
    neighbors = {"base": {"b01"}, "b01": {"base", "b02"}, "b02": {"b01", "husky"}, "husky": {"b02"}}
    main = all(team.stations(name, "mesh0") == dict.fromkeys(near, True) for name, near in neighbors.items())
    return main and all(
        team.stations(name, "mesh1") == {other: True} for name, other in zip(TWINS, TWINS[::-1], strict=True)
    )


def test_all_radios_join_their_configured_cell_and_all_neighbors_are_authorized(team: Team) -> None:
    for name in FIELDED:
        assert "Joined IBSS 02:ca:fe:00:00:21" in team.on(name, "iw dev mesh0 link")
        assert "channel 6 (2437 MHz), width: 20 MHz" in team.on(name, "iw dev mesh0 info")
    for name in TWINS:
        info = team.on(name, "iw dev mesh1 info")
        assert "type mesh point" in info
        assert "channel 36 (5180 MHz), width: 20 MHz" in info
    until(lambda: all_authorized(team), "every neighbor to be authorized")


def test_no_unencrypted_data_frames_are_transmitted(team: Team) -> None:
    words = control.run(team.fleet.directory, _LISTEN, timeout_s=120.0).check("listen").stdout.split()
    protected, clear = map(int, words)
    assert protected > 50
    assert clear == 0


def test_both_radios_of_one_node_are_in_its_mesh(team: Team) -> None:
    for name in TWINS:
        interfaces = team.on(name, "batctl meshif bat0 interface").split("\n")
        assert {line.split(":")[0] for line in interfaces if line.endswith("active")} == {"mesh0", "mesh1"}
    until(lambda: heard_over(team, "husky") == {"mesh0": {"b02"}, "mesh1": {"b02"}}, "b02 over both radios")
    until(lambda: heard_over(team, "b02")["mesh1"] == {"husky"}, "the Husky over five gigahertz")


@pytest.mark.proof
def test_a_node_with_the_wrong_key_cannot_join_the_mesh(team: Team) -> None:
    team.on(
        "husky", "for n in 0 1; do uci set wireless.mesh$n.key='a word of its own'; done; uci commit; reload_config"
    )
    try:
        until(lambda: not any(heard_over(team, "b02")[face] & {"husky"} for face in ("mesh0", "mesh1")), "it to be out")
        assert not any(team.stations("husky", "mesh1").values())
    finally:
        for number, key in enumerate(("main", "fast")):
            team.on("husky", f"uci set wireless.mesh{number}.key='{KEYS[key]}'; uci commit")
        team.on("husky", "reload_config")
    team.settle()


# test_mesh_changes.py changes it with the channel and the BSSID, in every run
@pytest.mark.proof
def test_a_new_key_is_rolled_out_over_the_running_mesh(team: Team) -> None:
    team.write_keys(main="the new word of all")
    last = team.provision(*FIELDED)[-1]
    assert {event["outcome"]["result"] for event in last if event["event"] == "finished"} <= {"done", "unchanged"}
    assert keys(team) == {"main": {"the new word of all"}, "fast": {KEYS["fast"]}}
    team.settle()
    until(lambda: all_authorized(team), "every neighbor to be authorized with the new key")
