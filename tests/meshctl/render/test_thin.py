"""Thin links that meshctl writes, the daemon's own reader loads; both compute the same airtime, limits and sizes."""

from __future__ import annotations

from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import pytest

from meshctl.diagnostics import InvalidInput
from meshctl.model import Fleet, ThinBand, ThinFraming, ThinLink, ThinPorts, ThinPreset, Topic, TopicClass
from meshctl.model import thin as model
from meshctl.render.daemon import daemon_config
from meshctl.render.thin import BAUD_RATES, frame_problems
from tests.meshctl.render.test_daemon import fleet, loaded
from udp_mesh.core.thin import lora
from udp_mesh.core.thin import settings as core
from udp_mesh.links import meshtastic_port, serial_port
from udp_mesh.links.meshtastic_port import MeshtasticPortConfig
from udp_mesh.links.serial_port import SerialPortConfig
from udp_mesh.wire import framings, limits
from udp_mesh.wire import thin as wire

ESTOP = Topic("estop", 0, TopicClass.EMERGENCY_STOP, thin=True)
POSE = Topic("pose", 9, thin=True, thin_links=("lora",), thin_period_s=60.0)
LORA = ThinLink(5470.0, ThinBand.EU868, 57_600, 120, 0.0125)
HOPPING = ThinLink(5470.0, ThinBand.US915, frame_bytes=255)
XBEE = ThinLink(10_000.0, ThinBand.EU869, frame_bytes=240, framing=ThinFraming.XBEE_ESCAPED)


def meshtastic(preset: ThinPreset, **keys: Any) -> ThinLink:
    return ThinLink(preset.bits_per_s, frame_s=preset.frame_s, framing=ThinFraming.MESHTASTIC, preset=preset, **keys)


def thin(*topics: Topic, ports: dict[str, str], **links: ThinLink) -> Fleet:
    source = fleet(*topics, thin_links=links, thin_presence_s=30.0)
    robots = {**source.robots, "uav": replace(source.robots["uav"], thin=ThinPorts(3, ports))}
    return replace(source, robots=robots)


def test_a_robots_ports_and_the_bands_limits_reach_its_daemon(tmp_path: Path) -> None:
    ports = {"lora": "/dev/ttyUSB0", "far": "/dev/ttyUSB1", "x": "/dev/x"}
    source = thin(ESTOP, POSE, ports=ports, lora=LORA, far=HOPPING, x=XBEE)
    configuration = loaded(source, "uav", tmp_path)
    settings = configuration.settings.thin
    assert (settings.number, settings.presence_s) == (3, 30.0)
    lora, far, _ = settings.links
    assert (lora.duty_cycle, lora.max_airtime_s, lora.frame_bytes) == (0.01, None, 120)
    assert (far.duty_cycle, far.max_airtime_s) == (1.0, 0.4)
    assert configuration.thin_ports == (
        SerialPortConfig("lora", "/dev/ttyUSB0", 57_600),
        SerialPortConfig("far", "/dev/ttyUSB1", 57_600),
        SerialPortConfig("x", "/dev/x", 57_600, "xbee-escaped"),
    )
    topics = {topic.name: topic for topic in configuration.settings.topics}
    assert (topics["estop"].thin, topics["estop"].links) == (True, ())
    assert (topics["pose"].links, topics["pose"].thin_period_s) == (("lora",), 60.0)


def test_robots_without_ports_know_the_topics_and_have_no_links(tmp_path: Path) -> None:
    source = thin(ESTOP, ports={"lora": "/dev/ttyUSB0"}, lora=LORA)
    configuration = loaded(source, "spot", tmp_path)
    assert configuration.settings.thin == core.ThinSettings()
    assert any(topic.name == "estop" and topic.thin for topic in configuration.settings.topics)


def test_a_fleet_without_thin_links_has_no_key_that_earlier_daemons_reject() -> None:
    assert b"thin" not in daemon_config(fleet(replace(ESTOP, thin=False)), "spot")


@pytest.mark.parametrize(
    ("link", "topic", "message"),
    [
        (replace(LORA, baud=12_345), ESTOP, "expected a standard speed"),
        (replace(LORA, bits_per_s=300.0, frame_bytes=255), ESTOP, "expected frames of at most"),
        (LORA, replace(ESTOP, delta=True), "expected no compression, delta or log"),
    ],
)
def test_what_the_daemon_would_reject_is_refused(link: ThinLink, topic: Topic, message: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        daemon_config(thin(topic, ports={"lora": "/dev/ttyUSB0"}, lora=link), "uav")
    assert message in str(caught.value)


def test_a_port_of_an_unknown_link_is_refused() -> None:
    with pytest.raises(InvalidInput, match=r"expected one of udp_mesh.thin_links"):
        daemon_config(thin(ESTOP, ports={"xbee": "/dev/ttyUSB0"}, lora=LORA), "uav")


@pytest.mark.parametrize(
    "link", [LORA, HOPPING, XBEE, replace(LORA, bits_per_s=1000.0, frame_bytes=60), *map(meshtastic, ThinPreset)]
)
def test_both_compute_the_same(link: ThinLink, tmp_path: Path) -> None:
    assert list(frame_problems(link)) == []
    [own] = loaded(thin(ESTOP, ports={"lora": "/dev/x"}, lora=link), "uav", tmp_path).settings.thin.links
    assert own.airtime_s(50) == pytest.approx(link.airtime_s(50))
    assert own.largest_frame_bytes == link.largest_frame_bytes
    core.check_thin("r" * link.longest_name_bytes, [], (own,))
    with pytest.raises(ValueError, match=f"at most {link.longest_name_bytes} bytes"):
        core.check_thin("r" * (link.longest_name_bytes + 1), [], (own,))


def test_the_constants_are_those_of_the_transport() -> None:
    assert {framing.value for framing in ThinFraming} == {*framings.FRAMINGS, meshtastic_port.MESHTASTIC}
    assert ThinFraming.MESHTASTIC.overhead_bytes == lora.MESHTASTIC_OVERHEAD_BYTES
    assert model.MAX_MESHTASTIC_FRAME_BYTES == meshtastic_port.MAX_PAYLOAD_BYTES
    assert {preset.name: preset.value for preset in ThinPreset} == {
        name: astuple(preset) for name, preset in lora.PRESETS.items()
    }
    for framing in set(ThinFraming) - {ThinFraming.MESHTASTIC}:
        own = framings.FRAMINGS[framing.value]
        assert (framing.overhead_bytes, framing.frame_bytes) == (own.overhead_bytes, own.frame_bytes)
    assert (model.MIN_FRAME_BYTES, model.MAX_FRAME_BYTES) == (core.MIN_FRAME_BYTES, limits.MAX_THIN_FRAME_BYTES)
    assert model.MAX_PARTS == limits.MAX_THIN_PARTS
    assert model.PART_OVERHEAD_BYTES == wire.THIN_OVERHEAD_BYTES + wire.PART_BYTES
    assert (model.BURST_SHARE, model.URGENT_SHARE) == (core.BURST_SHARE, core.URGENT_SHARE)
    assert set(BAUD_RATES) <= set(serial_port.BAUD_RATES)


def test_a_link_without_a_framing_has_no_key_that_earlier_daemons_reject() -> None:
    ports = {"lora": "/dev/ttyUSB0", "x": "/dev/x"}
    text = daemon_config(thin(ESTOP, ports=ports, lora=LORA, x=XBEE), "uav").decode()
    assert text.count("framing = ") == text.count('framing = "xbee-escaped"') == 1


def test_a_meshtastic_radio_reaches_its_daemon(tmp_path: Path) -> None:
    link = meshtastic(ThinPreset.LONG_FAST, band=ThinBand.EU869, frame_bytes=233, hop_limit=3)
    configuration = loaded(thin(ESTOP, ports={"m": "/dev/ttyACM0"}, m=link), "uav", tmp_path)
    assert configuration.thin_ports == (MeshtasticPortConfig("m", "/dev/ttyACM0", 3),)
    [own] = configuration.settings.thin.links
    assert (own.frame_bytes, own.duty_cycle) == (233, 0.1)
