"""Two real daemons: what programs at one read decides what the other sends; the guide's commands and program work."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import udp_mesh
from tests.processes import killed_on_failure
from tests.udp_mesh.daemon.processes import RunningDaemon, collect, outcomes, poll, two_daemons
from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh.client import MeshClient, MeshError, mesh_client

Pair = tuple[RunningDaemon, RunningDaemon]
GUIDE = (Path(udp_mesh.__file__).parents[1] / "docs" / "how-to" / "save-airtime.md").read_text()
TOPICS = """
probe = { priority = 6, reliable = false }
telemetry = { priority = 6, always = true }
found = { priority = 5, outbox = "all", outbox_on_disk = true }
"""

pytestmark = pytest.mark.xdist_group("udp_mesh_daemons")


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with two_daemons(TOPICS) as daemons:
        yield daemons


def read_at_bob(alice: RunningDaemon) -> list[dict[str, Any]] | None:
    """What programs at bob read, as alice knows it; None if she does not."""
    with alice.client() as client:
        (peer,) = client.request("subscriptions")["peers"]
    found: list[dict[str, Any]] | None = peer["reads"]
    return found if peer["known"] else None


def await_read(alice: RunningDaemon, *patterns: str) -> None:
    """Waits until alice knows that programs at bob read exactly these."""

    def known() -> bool:
        with alice.client() as client:
            # Asks if it is not known yet.
            client.publish("probe", b"", to="bob")
        entries = read_at_bob(alice)
        return entries is not None and {entry["topics"] for entry in entries} == set(patterns)

    poll(known, f"alice knows that bob reads {patterns}")


def outcome(client: MeshClient) -> dict[str, Any]:
    while (frame := client.next_frame(WAIT_S)) is not None:
        if frame[0].get("event") == "outcome":
            return frame[0]
    raise AssertionError("no outcome")


def test_a_message_that_no_program_reads_ends_as_not_wanted_and_is_counted(pair: Pair) -> None:
    alice, bob = pair
    await_read(alice)
    with alice.client() as sender, bob.client() as receiver:
        sender.publish("map", b"x" * 5000, to="bob", notify=True)
        ended = outcome(sender)
        assert (ended["outcome"], ended["reason"], ended["peer"]) == ("expired", "not wanted", "bob")
        (peer,) = sender.request("peers")["peers"]
        assert peer["saved_messages"] >= 1
        assert peer["saved_bytes"] >= 5000
        page = sender.request_frame("metrics")[1].decode()
        assert re.search(r'^udp_mesh_peer_saved_bytes_total\{peer="bob"\} [1-9]', page, re.MULTILINE)
        receiver.subscribe("map")
        await_read(alice, "map")
        number = sender.publish("map", b"now", to="bob", notify=True)
        assert number is not None
        assert outcomes(sender, 1) == {number: "delivered"}
        assert collect(receiver, 1)[0].payload == b"now"


def test_topics_sent_in_any_case_are_delivered_unread(pair: Pair) -> None:
    alice, _ = pair
    await_read(alice)
    with alice.client() as sender:
        numbers = [sender.publish(topic, b"x", to="bob", notify=True) for topic in ("status", "telemetry", "found")]
        assert outcomes(sender, 3) == dict.fromkeys(numbers, "delivered")


def test_a_rate_and_an_age_reach_the_sender_and_hold_for_this_program_alone(pair: Pair) -> None:
    alice, bob = pair
    with alice.client() as sender, bob.client() as slow, bob.client() as fast:
        slow.subscribe("telemetry", rate_hz=0.01, max_age_s=30)
        await_read(alice, "telemetry")
        assert read_at_bob(alice) == [{"topics": "telemetry", "rate_hz": 0.01, "max_age_s": 30.0}]
        fast.subscribe("telemetry")
        poll(lambda: (read_at_bob(alice) or [{}])[0].get("rate_hz", 0) is None, "alice knows of the second program")
        for turn in range(5):
            sender.publish("telemetry", b"%d" % turn, to="bob")
        assert [message.payload for message in collect(fast, 5)] == [b"0", b"1", b"2", b"3", b"4"]
        assert [message.payload for message in slow.messages(0.2)] == [b"0"]


@pytest.mark.parametrize(
    "fields",
    [
        {"rate_hz": 0},
        {"rate_hz": "fast"},
        {"rate_hz": True},
        {"max_age_s": -1},
        {"max_age_s": 10**400},
        {"topics": [""]},
    ],
)
def test_faulty_bounds_are_refused(pair: Pair, fields: dict[str, Any]) -> None:
    _, bob = pair
    with bob.client() as client, pytest.raises(MeshError, match=f"{next(iter(fields))}: expected") as refused:
        client.request("subscribe", **{"topics": ["map"], **fields})
    assert refused.value.code == "bad-request"


def test_the_guides_commands_and_program_work(pair: Pair, tmp_path: Path) -> None:
    alice, bob = pair
    (echo,) = re.findall(r"^ {8}udp-mesh (echo .*)$", GUIDE, re.MULTILINE)
    command = [sys.executable, "-m", "udp_mesh.cli.main", *echo.split(), "--json", "--count", "2"]
    environment = {**os.environ, "UDP_MESH_SOCKET": str(bob.socket)}
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as program,
        killed_on_failure(program),
        alice.client() as sender,
    ):
        await_read(alice, "video")
        assert read_at_bob(alice) == [{"topics": "video", "rate_hz": 2.0, "max_age_s": 5.0}]
        shown = subprocess.run(
            [sys.executable, "-m", "udp_mesh.cli.main", "subscriptions", "--socket", str(alice.socket)],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        assert re.search(r"^bob +video +2 Hz +5 s$", shown, re.MULTILINE)
        assert program.stdout is not None

        def ended() -> bool:
            sender.publish("video", b"frame", to="bob")
            return program.poll() is not None

        poll(ended, "the guide's command has printed two frames")
        assert [json.loads(line)["topic"] for line in program.stdout] == ["video", "video"]
    text = textwrap.dedent(re.findall(r"(?:^ {8}from mesh_client.*\n(?: {8}.*\n|\n)+)", GUIDE, re.MULTILINE)[0])
    (tmp_path / "mesh_client.py").write_text(
        Path(mesh_client.__file__).read_text().replace(mesh_client.DEFAULT_SOCKET, str(bob.socket))
    )
    script = text.replace("len(message.payload))", "len(message.payload), flush=True)")
    assert "rate_hz=2" in script
    with (
        subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, stdout=subprocess.PIPE, env={}) as program,
        killed_on_failure(program),
    ):
        await_read(alice, "video", "map", "artifacts/*")
        with alice.client() as sender:
            sender.publish("map", b"four", to="bob")
        assert program.stdout is not None
        # The last frame of video, which waited for its turn, may come first.
        assert b"alice map 4\n" in program.stdout
        program.kill()


def test_a_daemon_that_is_not_selective_sends_and_gets_everything() -> None:
    with two_daemons() as (alice, bob), bob.client() as client, alice.client() as sender:
        alice.write("selective = false\n" + alice.file.read_text())
        assert "selective: true -> false" in sender.request("reload")["changes"]
        assert client.request("subscriptions")["selective"]
        numbers = [sender.publish("map", b"x", to="bob", notify=True) for _ in range(3)]
        assert outcomes(sender, 3) == dict.fromkeys(numbers, "delivered")
        assert not sender.request("subscriptions")["selective"]
