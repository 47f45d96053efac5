"""Daemons whose thin link is a Meshtastic radio: the real client library, on pseudo-terminals of stand-ins."""

from __future__ import annotations

from typing import Any

from meshtastic.protobuf import mesh_pb2

from tests.udp_mesh.daemon.meshtastic_air import START, MeshtasticAir
from tests.udp_mesh.daemon.processes import RunningDaemon, collect, outcomes, poll
from tests.udp_mesh.daemon.test_thin_daemons import BITS_PER_S, present, team, without_datagrams

KEYS = 'framing = "meshtastic"\npreset = "SHORT_TURBO"\nhop_limit = 2\n'


def thin(daemon: RunningDaemon) -> dict[str, Any]:
    with daemon.client() as client:
        found: dict[str, Any] = client.request("status")["thin"]
    return found


def test_a_robot_without_wifi_hears_the_stop_through_meshtastic() -> None:
    radios = MeshtasticAir(2, bits_per_s=BITS_PER_S)
    with team(("base", "husky"), radios=radios, more=KEYS) as (_, [base, husky]):
        for daemon in (base, husky):
            without_datagrams(daemon)
            daemon.start()
        present(base, "husky")
        present(husky, "base")
        # Log lines of the firmware, damage, and packets of other programs end nothing.
        radios.inject(
            0, b"INFO | booted\r\n" + START + b"\xff\xff" + START + b"\x00\x03\xff\xff\xff" + bytes(range(256))
        )
        other = MeshtasticAir._received(77, 1, b"a text", 0)
        radios.write(radios.ports[0], other)
        with husky.client() as robot, base.client() as operator:
            robot.request("subscribe", topics=["estop", "report"])
            operator.request("publish", b"stop", topic="estop")
            assert [message.payload for message in collect(robot, 1)] == [b"stop"]
            payload = bytes(range(256))
            reply = operator.request("publish", payload, topic="report", to="husky", notify=True)
            [message] = collect(robot, 1)
            assert (message.topic, message.payload) == ("report", payload)
            assert outcomes(operator, 1) == {reply["message"]: "delivered"}
        radios.limited.add(0)
        poll(lambda: "DUTY_CYCLE_LIMIT" in thin(base)["refusals"].get("radio", ""), "the radio's refusal is reported")
    assert radios.hop_limits == {2}


def test_a_radio_that_does_not_answer_is_down_until_it_does() -> None:
    radios = MeshtasticAir(2, bits_per_s=BITS_PER_S)
    with team(("base", "husky"), radios=radios, more=KEYS) as (_, [base, husky]):
        for daemon in (base, husky):
            without_datagrams(daemon)
        device = radios.devices[0]
        base.write(base.file.read_text().replace(device, str(base.folder / "radio")))
        base.start()
        husky.start()
        assert "No such file" in thin(base)["failures"]["radio"]
        assert thin(base)["links"][0]["up"] is False
        (base.folder / "radio").symlink_to(device)
        present(base, "husky")
        assert thin(base)["failures"] == {}
        assert thin(base)["links"][0]["frame_bytes"] <= mesh_pb2.Constants.DATA_PAYLOAD_LEN
