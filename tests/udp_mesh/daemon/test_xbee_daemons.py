"""Daemons whose thin link is an XBee: API frames on pseudo-terminals, behind stand-ins for the radios."""

from __future__ import annotations

import pytest

from tests.udp_mesh.daemon.processes import collect, outcomes, poll
from tests.udp_mesh.daemon.test_thin_daemons import BITS_PER_S, present, team, without_datagrams
from tests.udp_mesh.daemon.xbee_air import XBeeAir
from udp_mesh.cli.views import status_view
from udp_mesh.wire.serial_framing import encode_line


@pytest.mark.parametrize(("framing", "escaped"), [("xbee", False), ("xbee-escaped", True)])
def test_a_robot_without_wifi_hears_the_stop_through_xbees(framing: str, escaped: bool) -> None:
    radios = XBeeAir(3, bits_per_s=BITS_PER_S, escaped=escaped)
    with team(("base", "husky", "uav"), radios=radios, more=f'framing = "{framing}"\n') as (_, daemons):
        base, husky, uav = daemons
        for daemon in daemons:
            without_datagrams(daemon)
            daemon.start()
        present(base, "husky", "uav")
        present(husky, "base")
        present(uav, "base")
        # What other firmware writes, and damage, end nothing.
        radios.inject(0, encode_line(b"transparent") + b"\x7e\x00\x05\x7d" + bytes(range(256)) + bytes(300))
        with husky.client() as robot, uav.client() as other, base.client() as operator:
            robot.request("subscribe", topics=["estop", "report"])
            other.request("subscribe", topics=["estop"])
            operator.request("publish", b"stop", topic="estop")
            assert [message.payload for message in collect(robot, 1)] == [b"stop"]
            assert [message.payload for message in collect(other, 1)] == [b"stop"]
            # Several parts, with every byte that is escaped.
            payload = b"\x7e\x7d\x11\x13" * 75
            reply = operator.request("publish", payload, topic="report", to="husky", notify=True)
            [message] = collect(robot, 1)
            assert (message.topic, message.payload) == ("report", payload)
            assert outcomes(operator, 1) == {reply["message"]: "delivered"}
            assert operator.request("status")["thin"]["refusals"] == {}
    assert radios.refused == 0


def test_a_radio_that_refuses_large_frames_is_reported() -> None:
    radios = XBeeAir(2, bits_per_s=BITS_PER_S, escaped=True, np=72)
    with team(("base", "husky"), radios=radios, more='framing = "xbee-escaped"\n') as (_, [base, husky]):
        for daemon in (base, husky):
            without_datagrams(daemon)
            daemon.start()
        present(base, "husky")
        with base.client() as operator:
            operator.request("publish", bytes(300), topic="report", to="husky")
            status = poll(
                lambda: found if (found := operator.request("status"))["thin"]["refusals"] else None,
                "the refusal is reported",
            )
        assert "set frame_bytes to its NP" in status["thin"]["refusals"]["radio"]
        assert "RADIO REFUSES" in status_view(status)
        assert "thin-link-radio-refuses link=radio" in base.log.read_text()
    assert radios.refused > 0
