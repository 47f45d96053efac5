"""What meshctl writes for the daemon, the daemon's own reader loads, and it means what the inventory says."""

from __future__ import annotations

import base64
from dataclasses import astuple, replace
from ipaddress import IPv4Address, IPv4Interface
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.model import (
    Computer,
    ComputerLink,
    FixedPosition,
    Fleet,
    JpegEncoding,
    Outbox,
    Reduction,
    Robot,
    Secret,
    SecretKind,
    SecretRef,
    Topic,
    TopicClass,
    TopicLog,
    UdpMesh,
)
from meshctl.render.bridge import bridge_config
from meshctl.render.daemon import RELAY_KEY_NAME, daemon_config, daemon_keys, relay_keys
from tests.meshctl.render import fleets
from udp_mesh.bridges.configuration import parse_configuration
from udp_mesh.bridges.reduction import JpegOptions
from udp_mesh.bridges.reduction import Reduction as BridgeReduction
from udp_mesh.core import settings as core
from udp_mesh.daemon.configuration import Configuration, load
from udp_mesh.links.attachments import LinkConfig

NEW, OLD = SecretRef(SecretKind.ENV, "NEW"), SecretRef(SecretKind.ENV, "OLD")
KEYS = {NEW: "11" * 32, OLD: base64.b64encode(bytes(range(32))).decode()}
ESTOP = Topic("estop", 0, TopicClass.EMERGENCY_STOP, "std_msgs/Bool")
MAPS = Topic(
    "maps/difference",
    7,
    TopicClass.MAP,
    destinations=("base", "spot"),
    keep_last=3,
    deadline_s=30,
    rate_limit_bytes_per_s=50_000,
    compression=True,
    outbox=Outbox.ALL,
    outbox_bytes=2_000_000,
    outbox_on_disk=True,
)
GRID = Topic("grid", 8, TopicClass.MAP, destinations=("base",), delta=True, delta_bytes=4_000_000)
VIDEO = Topic("video", 9, TopicClass.VIDEO, reliable=False, destinations=("base",), repair=True)


def fleet(*topics: Topic, robots: tuple[str, ...] = ("base", "spot", "uav"), **transport: Any) -> Fleet:
    members = {
        name: Robot(name, (), Computer(IPv4Interface(f"10.42.0.{number}/24")))
        for number, name in enumerate(robots, 100)
    }
    return fleets.fleet(robots=members, topics=topics, udp_mesh=replace(UdpMesh(keys=(NEW, OLD)), **transport))


def loaded(source: Fleet, robot: str, folder: Path) -> Configuration:
    (folder / "udp-mesh.toml").write_bytes(daemon_config(source, robot))
    keys = daemon_keys(source, lambda ref: Secret(KEYS[ref]))
    if keys is not None:
        (folder / "fleet.key").write_bytes(keys)
    return load(folder / "udp-mesh.toml")


def test_the_bridge_reads_what_the_inventory_reduces() -> None:
    jpeg = JpegEncoding(quality=40, min_quality=5, scale=0.5)
    camera = replace(VIDEO, reduce=Reduction(rate_hz=1.0, encode=jpeg, adapt=True))
    cloud = replace(GRID, reduce=Reduction(voxel_m=0.1, max_voxel_m=0.5, fields=("x", "y")))
    text = bridge_config(fleet(ESTOP, camera, cloud))
    assert text is not None
    assert parse_configuration(text.decode(), "bridge.yaml").reductions == {
        "video": BridgeReduction(1.0, JpegOptions(40, 5, 0.5), adapt=True),
        "grid": BridgeReduction(None, None, 0.1, 0.5, ("x", "y")),
    }
    assert bridge_config(fleet(ESTOP, GRID)) is None


def test_bridge_and_inventory_have_the_same_defaults() -> None:
    assert JpegOptions(*astuple(JpegEncoding())) == JpegOptions()
    assert BridgeReduction(*astuple(Reduction())) == BridgeReduction()


def test_a_topic_is_sent_at_the_lower_of_its_rates() -> None:
    camera = replace(VIDEO, rate_hz=30.0)
    assert [replace(camera, reduce=Reduction(rate_hz=rate)).sent_rate_hz for rate in (None, 1.0, 60.0)] == [30, 1, 30]


def test_the_daemon_configuration_matches_the_inventory(tmp_path: Path) -> None:
    found = loaded(fleet(ESTOP, MAPS, VIDEO, GRID, port=8701, heartbeat_s=0.5, metrics_port=9871), "uav", tmp_path)
    settings = found.settings
    assert (settings.name, settings.port, settings.window, settings.fragment_bytes) == ("uav", 8701, "adaptive", 1400)
    assert [key.secret for key in settings.keys] == [b"\x11" * 32, bytes(range(32))]
    assert (settings.rates.heartbeat_s, settings.rates.offline_s) == (0.5, 10.0)
    assert found.links == (LinkConfig(None, "10.42.0.102", broadcast=True),)
    assert found.daemon.metrics_address == ("127.0.0.1", 9871)
    topics = {topic.name: topic for topic in settings.topics}
    assert topics["estop"] == core.Topic("estop", 0)
    assert topics["maps/difference"] == core.Topic(
        "maps/difference",
        7,
        keep_last=3,
        deadline_s=30,
        rate_limit_bytes_per_s=50_000,
        compression=True,
        destinations=("base", "spot"),
        outbox=core.Outbox.ALL,
        outbox_bytes=2_000_000,
        outbox_on_disk=True,
    )
    assert topics["video"] == core.Topic("video", 9, reliable=False, destinations=("base",), repair=True)
    assert topics["grid"] == core.Topic("grid", 8, destinations=("base",), delta=True, delta_bytes=4_000_000)


def test_the_inventorys_default_and_bounds_of_delta_bytes_are_the_daemons(tmp_path: Path) -> None:
    assert Topic("grid", 8).delta_bytes == core.Topic("grid", 8).delta_bytes
    for size in (1, 1 << 30):
        found = loaded(fleet(replace(GRID, delta_bytes=size)), "uav", tmp_path).settings.topics
        assert {topic.delta_bytes for topic in found if topic.delta} == {size}


def test_what_is_sent_unread_is_written_only_where_it_differs_from_the_default(tmp_path: Path) -> None:
    """Daemons of earlier versions reject unknown keys."""
    telemetry = Topic("telemetry", 6)
    plain = daemon_config(fleet(telemetry), "uav").decode()
    assert "selective" not in plain
    assert "always" not in plain
    assert loaded(fleet(telemetry), "uav", tmp_path).settings.selective
    found = loaded(fleet(replace(telemetry, always=True), selective=False), "uav", tmp_path).settings
    assert not found.selective
    assert [topic for topic in found.topics if topic.name == "telemetry"] == [core.Topic("telemetry", 6, always=True)]


def test_the_destinations_of_a_log_are_its_readers(tmp_path: Path) -> None:
    """At the base, too, which reads it: a log has the same readers everywhere."""
    log = TopicLog(max_items=500, max_bytes=1_000_000, max_age_s=3600, copies=2)
    artifacts = Topic("artifacts", 4, destinations=("base",), compression=True, rate_limit_bytes_per_s=9000, log=log)
    for robot in ("base", "spot"):
        topics = {topic.name: topic for topic in loaded(fleet(artifacts), robot, tmp_path).settings.topics}
        assert topics["artifacts"] == core.Topic(
            "artifacts",
            4,
            compression=True,
            rate_limit_bytes_per_s=9000,
            log=core.Log(readers=("base",), max_items=500, max_bytes=1_000_000, max_age_s=3600, copies=2),
        )
    everybody = loaded(fleet(Topic("artifacts", 4, log=TopicLog())), "spot", tmp_path).settings.topics
    assert core.Topic("artifacts", 4, log=core.Log()) in everybody


def test_a_fixed_position_is_the_daemons_and_a_robot_without_one_has_none(tmp_path: Path) -> None:
    source = fleet(ESTOP)
    placed = replace(source.robots["base"], position=FixedPosition(12.5, -3.0))
    source = replace(source, robots={**source.robots, "base": placed})
    position = loaded(source, "base", tmp_path).position
    assert position is not None
    assert (position.x_m, position.y_m, position.z_m, position.frame) == (12.5, -3.0, None, "map")
    assert loaded(source, "uav", tmp_path).position is None


def relaying(relay: tuple[str, ...], robot: str = "spot", **transport: Any) -> Fleet:
    source = fleet(ESTOP, **transport)
    return replace(source, robots={**source.robots, robot: replace(source.robots[robot], relay=relay)})


@pytest.mark.parametrize(
    ("relay", "hops", "expected"),
    [
        (("uav",), 4, core.RelaySettings(("uav",))),
        (("uav", "base"), 2, core.RelaySettings(("uav", "base"), hops=2)),
        (("all",), 8, core.RelaySettings(all=True, hops=8)),
        (("all", "uav"), 4, core.RelaySettings(("uav",), all=True)),
    ],
)
def test_a_relay_is_that_robots_alone_and_the_limit_of_links_is_everybodys(
    relay: tuple[str, ...], hops: int, expected: core.RelaySettings, tmp_path: Path
) -> None:
    source = relaying(relay, relay_hops=hops)
    assert loaded(source, "spot", tmp_path).settings.relay == expected
    assert loaded(source, "uav", tmp_path).settings.relay == core.RelaySettings(hops=hops)


def test_relays_may_be_turned_off_for_the_whole_fleet(tmp_path: Path) -> None:
    assert loaded(fleet(ESTOP, relay_hops=1), "spot", tmp_path).settings.relay == core.RelaySettings(hops=1)


def test_a_fleet_without_relays_has_the_daemons_defaults_and_no_key_that_earlier_daemons_reject(tmp_path: Path) -> None:
    assert loaded(fleet(ESTOP), "spot", tmp_path).settings.relay == core.RelaySettings()
    assert b"relay" not in daemon_config(fleet(ESTOP), "spot")


@pytest.mark.parametrize(
    ("relay", "hops", "path", "message"),
    [
        (("all",), 1, "udp_mesh.relay_hops", "expected at least 2, because spot is a relay, found 1"),
        ((), 0, "udp_mesh.relay_hops", "expected 1 to 8, found 0"),
        ((), 9, "udp_mesh.relay_hops", "expected 1 to 8, found 9"),
        (("uav", "u av"), 4, "robots.spot.relay.1", "expected a name of 1 to 63 bytes without space or slash"),
        (("a/b",), 4, "robots.spot.relay.0", "found 'a/b'"),
        (("",), 4, "robots.spot.relay.0", "found ''"),
    ],
)
def test_a_relay_the_daemon_would_reject_is_rejected(
    relay: tuple[str, ...], hops: int, path: str, message: str
) -> None:
    with pytest.raises(InvalidInput) as caught:
        daemon_config(relaying(relay, relay_hops=hops), "spot")
    (found,) = caught.value.diagnostics
    assert (found.code, found.path) == ("RND030", path)
    assert message in found.text


@given(st.text(st.sampled_from("ab é\"\\'\x7f\n/~[].#=,中"), max_size=12))
def test_any_name_of_a_relay_is_loaded_unchanged_or_rejected(
    tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    try:
        found = loaded(relaying((name,)), "spot", tmp_path_factory.getbasetemp())
    except InvalidInput as error:
        assert {item.code for item in error.diagnostics} == {"RND030"}
        return
    assert found.settings.relay.names == (name,)


def test_without_broadcast_all_other_robots_are_neighbors(tmp_path: Path) -> None:
    found = loaded(fleet(broadcast=False, window=3), "base", tmp_path)
    assert found.settings.window == 3
    assert found.links == (LinkConfig(None, "10.42.0.100", broadcast=False),)
    assert [(peer.name, peer.address) for peer in found.settings.neighbours] == [
        ("spot", ("10.42.0.101", 8700)),
        ("uav", ("10.42.0.102", 8700)),
    ]


@pytest.mark.parametrize("robot", ["base", "spot"])
def test_daemons_in_a_mixed_fleet_know_the_legacy_robots(robot: str, tmp_path: Path) -> None:
    source = fleet(robots=("base", "spot"))
    robots = {**source.robots, "husky2": Robot("husky2", (), fielded=IPv4Address("10.42.0.120"))}
    found = loaded(replace(source, robots=robots), robot, tmp_path)
    assert found.settings.neighbours == (core.Neighbour(("10.42.0.120", 8700), "husky2", legacy=True),)
    assert found.links == (LinkConfig(None, f"10.42.0.{100 if robot == 'base' else 101}", broadcast=True),)


def test_a_robot_is_not_its_own_destination_unless_it_is_the_only_one(tmp_path: Path) -> None:
    topics = {topic.name: topic for topic in loaded(fleet(MAPS, VIDEO), "base", tmp_path).settings.topics}
    assert topics["maps/difference"].destinations == ("spot",)
    assert topics["video"].destinations == ("base",)


def test_a_fleet_without_keys_configures_the_daemon_as_unkeyed(tmp_path: Path) -> None:
    bench = fleet(keys=())
    assert daemon_keys(bench, lambda ref: Secret(KEYS[ref])) is None
    assert loaded(bench, "base", tmp_path).settings.unkeyed


@pytest.mark.parametrize(("heartbeat_s", "offline_s"), [(1, 10), (5, 30), (0.1, 1), (2, 600)])
def test_the_offline_timeout_exceeds_three_heartbeats(heartbeat_s: float, offline_s: float, tmp_path: Path) -> None:
    rates = loaded(fleet(heartbeat_s=heartbeat_s, offline_after_s=offline_s), "base", tmp_path).settings.rates
    assert rates.heartbeat_s <= rates.heartbeat_sparse_s
    assert 3 * rates.heartbeat_sparse_s < rates.offline_s <= rates.peer_lost_s


@given(st.text(max_size=12), st.text(st.sampled_from("ab é\"\\'\x7f\n/~[].#=中"), max_size=12))
def test_any_name_is_loaded_unchanged_or_rejected(
    tmp_path_factory: pytest.TempPathFactory, robot: str, topic: str
) -> None:
    source = fleet(Topic(topic, 5), robots=(robot,))
    try:
        found = loaded(source, robot, tmp_path_factory.getbasetemp())
    except InvalidInput as error:
        assert {item.code for item in error.diagnostics} == {"RND030"}
        return
    assert found.settings.name == robot
    assert topic in {item.name for item in found.settings.topics}


@pytest.mark.parametrize(
    ("changes", "path"),
    [
        ({"fragment_bytes": 9000}, "udp_mesh.fragment_bytes"),
        ({"window": 5000}, "udp_mesh.window"),
        ({"keys": (NEW, OLD, NEW)}, "udp_mesh.keys"),
    ],
)
def test_settings_the_daemon_would_reject_are_rejected(changes: dict[str, Any], path: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        daemon_config(fleet(**changes), "base")
    assert [item.path for item in caught.value.diagnostics] == [path]


def test_unknown_robots_and_those_without_a_computer_are_refused() -> None:
    source = fleet()
    with pytest.raises(InvalidInput, match="expected a robot of the fleet, found 'nobody'"):
        daemon_config(source, "nobody")
    bare = replace(source, robots={"spot": Robot("spot", ())})
    with pytest.raises(InvalidInput, match="expected a robot with a computer, found none"):
        daemon_config(bare, "spot")


@pytest.mark.parametrize("key", ["", "short", "zz" * 32, "11" * 31, "é" * 64])
def test_an_invalid_key_is_rejected_without_being_shown(key: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        daemon_keys(fleet(keys=(NEW,)), lambda _: Secret(key))
    assert not key or key not in str(caught.value)


def test_a_missing_key_is_reported_at_its_position() -> None:
    def none(ref: SecretRef) -> Secret:
        raise InputError(f"secret {ref}: not set")

    with pytest.raises(InvalidInput, match=r"udp_mesh\.keys\.0: secret env:NEW: not set"):
        daemon_keys(fleet(), none)


def test_the_daemon_configuration_is_deterministic() -> None:
    source = fleet(ESTOP, MAPS, VIDEO)
    assert daemon_config(source, "spot") == daemon_config(source, "spot")


def test_with_a_routed_lan_every_daemon_has_all_others_as_fixed_neighbors(tmp_path: Path) -> None:
    source = fleets.routed_lans()
    for name, others in {
        "base-station": {("husky1", "10.43.1.10"), ("spot", "10.43.2.10")},
        "spot": {("base-station", "10.42.0.100"), ("husky1", "10.43.1.10")},
    }.items():
        found = loaded(source, name, tmp_path)
        assert {(one.name, one.address[0]) for one in found.settings.neighbours} == others
        assert [link.broadcast for link in found.links] == [False]


def with_links(*links: ComputerLink, **transport: Any) -> Fleet:
    source = fleet(ESTOP, **transport)
    spot = source.robots["spot"]
    assert spot.computer is not None
    changed = replace(spot, computer=replace(spot.computer, links=links))
    return replace(source, robots={**source.robots, "spot": changed})


def test_further_links_are_the_robots_alone_and_may_have_fixed_neighbors(tmp_path: Path) -> None:
    tether = ComputerLink(address=IPv4Address("10.50.0.1"), neighbors={"uav": IPv4Address("10.50.0.2")}, mtu=1400)
    source = with_links(ComputerLink("wlan*"), tether)
    found = loaded(source, "spot", tmp_path)
    assert found.links == (
        LinkConfig(None, "10.42.0.101"),
        LinkConfig("wlan*", None),
        LinkConfig(None, "10.50.0.1", broadcast=False, mtu=1400),
    )
    (uav,) = found.settings.neighbours
    assert (uav.address, uav.name, uav.link) == (("10.50.0.2", 8700), None, "10.50.0.1")
    assert loaded(source, "uav", tmp_path).links == (LinkConfig(None, "10.42.0.102"),)


def test_a_robot_may_be_a_fixed_neighbor_on_two_links(tmp_path: Path) -> None:
    link = ComputerLink("eth1", neighbors={"uav": IPv4Address("10.50.0.2")})
    found = loaded(with_links(link, broadcast=False), "spot", tmp_path)
    addresses = sorted(peer.address[0] for peer in found.settings.neighbours)
    assert addresses == ["10.42.0.100", "10.42.0.102", "10.50.0.2"]


@pytest.mark.parametrize(
    ("links", "message"),
    [
        ((ComputerLink(),), "expected an interface or an address, found neither"),
        ((ComputerLink("wlan1", IPv4Address("10.50.0.1")),), "expected an interface or an address, found both"),
        ((ComputerLink("wlan1"), ComputerLink("wlan1")), "expected another link than those before, found wlan1"),
        ((ComputerLink(address=IPv4Address("10.42.0.101")),), "expected another link than those before"),
    ],
)
def test_a_link_the_daemon_would_reject_is_rejected(links: tuple[ComputerLink, ...], message: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        daemon_config(with_links(*links), "spot")
    (found,) = caught.value.diagnostics
    assert (found.code, found.path) == ("RND030", f"robots.spot.computer.links.{len(links) - 1}")
    assert message in found.text


def test_relay_keys_are_a_file_of_their_own(tmp_path: Path) -> None:
    source = replace(fleet(ESTOP), udp_mesh=UdpMesh(keys=(NEW,), relay_keys=(OLD,)))
    written = relay_keys(source, lambda ref: Secret(KEYS[ref]))
    assert written is not None
    (tmp_path / RELAY_KEY_NAME).write_bytes(written)
    found = loaded(source, "spot", tmp_path)
    assert len(found.settings.relay.keys) == 1
    assert found.settings.relay.keys[0] not in found.settings.keys
    assert relay_keys(fleet(ESTOP), lambda ref: Secret(KEYS[ref])) is None
    with pytest.raises(InvalidInput) as caught:
        relay_keys(source, lambda _: Secret("short"))
    assert caught.value.diagnostics[0].path == "udp_mesh.relay_keys.0"
