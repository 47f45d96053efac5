"""A Meshtastic radio's port: what is missing is said at once, a radio that goes away at the next use, nothing waits."""

from __future__ import annotations

import pytest

from tests.udp_mesh.daemon.meshtastic_air import MeshtasticAir
from tests.waiting import until
from udp_mesh.links import meshtastic_port
from udp_mesh.links.meshtastic_port import MAX_WAITING_FRAMES, MeshtasticPort, MeshtasticPortConfig


def test_a_missing_library_is_named_with_the_way_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meshtastic_port, "find_spec", lambda name: None)
    with pytest.raises(OSError, match="pip install meshtastic"):
        MeshtasticPort(MeshtasticPortConfig("radio", "/dev/null"))


def test_a_missing_device_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="/dev/no-radio"):
        MeshtasticPort(MeshtasticPortConfig("radio", "/dev/no-radio"))


def failure(port: MeshtasticPort) -> str | None:
    try:
        port.receive()
    except OSError as error:
        return str(error)
    return None


def test_what_is_no_serial_port_fails() -> None:
    port = MeshtasticPort(MeshtasticPortConfig("radio", "/dev/null"))
    try:
        assert "/dev/null" in until(lambda: failure(port), "the port fails")
        assert not port.ready
    finally:
        port.close()
    port._thread.join(10)
    assert not port._thread.is_alive()


def test_a_radio_that_does_not_answer_loses_frames_and_is_left_when_it_does() -> None:
    radios = MeshtasticAir(1, bits_per_s=20_000)
    port = MeshtasticPort(MeshtasticPortConfig("radio", radios.devices[0]))
    try:
        for _ in range(3 * MAX_WAITING_FRAMES):
            port.send(b"frame")
        assert port._to_send.qsize() == MAX_WAITING_FRAMES
        assert port.frames_lost == 2 * MAX_WAITING_FRAMES
        assert port.receive() == []
        assert not port.ready
    finally:
        port.close()
    radios.start()
    port._thread.join(10)
    radios.stop()
    assert not port._thread.is_alive()
    assert radios.airtimes(0) == []


def test_a_radio_that_goes_away_is_an_error() -> None:
    radios = MeshtasticAir(1, bits_per_s=20_000)
    radios.start()
    port = MeshtasticPort(MeshtasticPortConfig("radio", radios.devices[0]))
    try:
        until(lambda: port.receive() == [] and port.ready, "the radio answers")
        radios.stop()
        assert "the radio is gone" in until(lambda: failure(port), "its end is noticed")
    finally:
        port.close()
    port._thread.join(10)
    assert not port._thread.is_alive()
