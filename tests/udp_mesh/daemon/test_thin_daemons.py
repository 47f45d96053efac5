"""Daemons with thin links: serial ports (pseudo-terminals) behind a radio channel with a rate, loss and collisions."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.udp_mesh.daemon.processes import RATES, RunningDaemon, collect, configuration, outcomes, poll, wait_online
from tests.udp_mesh.daemon.serial_air import SerialAir, running
from tests.udp_mesh.links.sockets import free_port
from tests.waiting import until
from udp_mesh.cli.views import status_view
from udp_mesh.daemon.configuration import read
from udp_mesh.daemon.toml_source import ConfigurationError, parse
from udp_mesh.report.aggregate import read as read_recording
from udp_mesh.wire.serial_framing import encode_line

BITS_PER_S = 20_000
POSITION_WAIT_S = 300.0
"""Time for ten positions, of which each is lost with the link's 10 %."""
TOPICS = """
estop = { priority = 0, thin = true }
report = { priority = 8, thin = true }
"""


def thin(number: int, device: str, more: str = "") -> str:
    return f"""
[thin]
number = {number}
presence_s = 2
[[thin.links]]
name = "radio"
device = "{device}"
bits_per_s = {BITS_PER_S}
frame_bytes = 100
{more}"""


@contextmanager
def team(
    names: tuple[str, ...], *, loss: float = 0.0, radios: SerialAir | None = None, more: str = ""
) -> Iterator[tuple[SerialAir, list[RunningDaemon]]]:
    """Daemons on one channel, not started yet; they also have datagrams. `more` are keys of the thin link."""
    with (
        tempfile.TemporaryDirectory(prefix="udp-mesh-") as path,
        running(radios or SerialAir(len(names), bits_per_s=BITS_PER_S, loss=loss)) as air,
    ):
        port, numbers = free_port(), range(1, len(names) + 1)
        daemons = []
        for number, name in enumerate(names, 1):
            others = [other for other in numbers if other != number]
            links = thin(number, air.devices[number - 1], more)
            text = configuration(Path(path), name, number, others, port, topics=TOPICS, rates=links + RATES)
            daemons.append(RunningDaemon(Path(path), name, text))
        try:
            yield air, daemons
        finally:
            for daemon in daemons:
                daemon.stop()


def without_datagrams(daemon: RunningDaemon) -> None:
    """Another key file would end the thin link too: its neighbors are removed instead."""
    text = daemon.file.read_text()
    head, _, rest = text.partition("[[neighbours]]")
    daemon.write(head + rest[rest.index("[topics]") :])


def present(daemon: RunningDaemon, *names: str) -> None:
    """Wait until the daemon hears these nodes on its thin link, and they hear it."""

    def heard() -> bool:
        with daemon.client() as client:
            found = client.request("status")["thin"]["peers"]
        return set(names) <= {peer["name"] for peer in found if peer["present"]}

    poll(heard, f"{daemon.name} hears {names}: {daemon.log.read_text()}")


def test_a_robot_without_wifi_reports_its_position_and_hears_the_stop() -> None:
    with team(("base", "husky"), loss=0.1) as (_, [base, husky]):
        for daemon in (base, husky):
            without_datagrams(daemon)
            daemon.start()
        present(base, "husky")
        present(husky, "base")
        with husky.client() as robot, base.client() as operator:
            operator.request("record-start", path=str(base.file.with_name("run.jsonl")))
            # Before the stop, which could collide with it: positions are not repeated, and come every 30 s.
            robot.request("set-position", x_m=3.0, y_m=4.0)
            until(
                lambda: next((one for one in operator.request("status")["positions"] if one["name"] == "husky"), None),
                "husky's position arrives",
                wait_s=POSITION_WAIT_S,
            )
            robot.request("subscribe", topics=["estop"])
            reply = operator.request("publish", b"stop", topic="estop", to="husky", notify=True)
            [message] = collect(robot, 1)
            assert (message.topic, message.payload, message.source) == ("estop", b"stop", "base")
            assert outcomes(operator, 1) == {reply["message"]: "delivered"}
            status = operator.request("status")
            operator.request("record-stop")
        recording = read_recording(base.file.with_name("run.jsonl"))
        assert recording.problems == []
        radio = recording.thin_links["radio"]
        assert radio.up_share == 1.0
        assert radio.totals.frames_received > 0
        assert 0 < radio.totals.airtime_s < radio.last.t
        assert list(recording.thin_present) == ["husky"]
        assert [peer["name"] for peer in status["conditions"]["peers"] if peer["online"]] == []
        view = status_view(status)
        assert "ONLY HERE" in view
        assert "husky" in view


def test_beside_wifi_each_urgent_message_arrives_once() -> None:
    with team(("base", "husky")) as (air, [base, husky]):
        for daemon in (base, husky):
            daemon.start()
        wait_online(base, "husky")
        present(base, "husky")
        with husky.client() as robot, base.client() as operator:
            robot.request("subscribe", topics=["estop", "report"])
            for number in range(5):
                operator.request("publish", bytes((number,)), topic="estop")
            messages = collect(robot, 5)
            assert sorted(message.payload for message in messages) == [bytes((number,)) for number in range(5)]
            poll(
                lambda: operator.request("status")["thin"]["links"][0]["queued_messages"] == 0 or None,
                "the thin link has sent what it had",
            )
            operator.request("publish", b"last", topic="report")
            [last] = collect(robot, 1)
            assert last.payload == b"last"
        assert air.delivered > 0


def test_noise_and_a_radio_that_is_pulled_out_do_not_end_a_daemon() -> None:
    with team(("base", "husky")) as (air, [base, husky]):
        device = Path(air.devices[0])
        for daemon in (base, husky):
            without_datagrams(daemon)
        base.write(base.file.read_text().replace(str(device), str(base.folder / "radio")))
        base.start()
        husky.start()

        def failure() -> str | None:
            with base.client() as client:
                found: str | None = client.request("status")["thin"]["failures"].get("radio")
            return found

        assert "No such file" in poll(failure, "the missing device is reported")
        (base.folder / "radio").symlink_to(device)
        present(base, "husky")
        air.inject(0, bytes(range(256)) * 20)
        air.inject(0, b"".join(encode_line(bytes((number,)) * 30) for number in range(1, 60)))
        with husky.client() as robot, base.client() as operator:
            operator.request("subscribe", topics=["report"])
            robot.request("publish", b"still here", topic="report", to="base")
            [message] = collect(operator, 1)
            assert message.payload == b"still here"


def test_a_reload_opens_another_port() -> None:
    with team(("base", "husky")) as (air, [base, husky]):
        for daemon in (base, husky):
            without_datagrams(daemon)
        complete = base.file.read_text()
        base.write(complete.replace(air.devices[0], "/dev/null"))
        base.start()
        husky.start()
        with base.client() as client:
            assert "not a serial port" in client.request("status")["thin"]["failures"]["radio"]
            base.write(complete)
            assert client.request("reload")["changes"] == []
            assert client.request("status")["thin"]["failures"] == {}
            present(base, "husky")
            base.write(complete.replace("presence_s = 2", "presence_s = 3"))
            assert client.request("reload")["changes"] == ["thin links"]
            present(base, "husky")
            present(husky, "base")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[thin]\nnumber = 0\n", "thin.number: expected an integer from 1 to 254, found 0"),
        ('[[thin.links]]\ndevice = "/dev/x"\n', "thin.number: expected this node's number, 1 to 254, found none"),
        ("[thin]\nnumber = 3\n[[thin.links]]\n", "thin.links.0.device: expected a serial port"),
        (
            '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\nbaud = 1234\n',
            "expected a speed that the kernel knows",
        ),
        (
            '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\nframing = "xbee"\n',
            "thin.links.0.bits_per_s: expected the radio's rate on the air",
        ),
        (
            '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\nframing = "slip"\n',
            'expected "cobs" or "xbee" or "xbee-escaped" or "meshtastic"',
        ),
        (
            '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\nframing = "meshtastic"\nframe_bytes = 240\n',
            "expected an integer from 40 to 233, found 240",
        ),
        (
            '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\nframing = "meshtastic"\nhop_limit = 4\n',
            "hop_limit: expected an integer from 0 to 3, found 4",
        ),
        (
            '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\nframing = "meshtastic"\nbaud = 9600\n',
            "baud",
        ),
        (
            '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\npreset = "LONG_FAST"\n',
            "preset",
        ),
        (
            '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\nbits_per_s = 1000\nduty_cycle = 0.001\n',
            "expected frames of at most",
        ),
        (
            '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\n[[thin.links]]\ndevice = "/dev/y"\n',
            "expected each name once",
        ),
    ],
)
def test_mistakes_in_the_configuration_are_reported(text: str, problem: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        read(parse(f'name = "a"\nunkeyed = true\n{text}', "file.toml"), ())
    assert problem in str(caught.value)


def test_a_name_that_does_not_fit_the_frames_is_refused_at_its_line() -> None:
    text = '[thin]\nnumber = 3\n[[thin.links]]\ndevice = "/dev/x"\nframe_bytes = 40\n'
    with pytest.raises(ConfigurationError) as caught:
        read(parse(f'unkeyed = true\nname = "base-station-2"\n{text}', "file.toml"), ())
    assert "file.toml:2: name: expected a name of at most 12 bytes" in str(caught.value)
    assert "frames of thin link thin have 40 bytes, found base-station-2" in str(caught.value)
