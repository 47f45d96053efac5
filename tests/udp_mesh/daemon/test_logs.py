"""Shared logs between real daemons: items reach a base that never meets their source, and outlive kills."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.udp_mesh.daemon.processes import RunningDaemon, collect, configuration, outcomes, poll, wait_online
from tests.udp_mesh.links.sockets import free_port
from udp_mesh.cli.views import logs_view
from udp_mesh.client import MeshError

ARTIFACT = 'artifact = { priority = 4, log = { readers = ["base"] } }'
ADDRESSES = {"base": 1, "husky": 2, "spot": 3}

pytestmark = pytest.mark.xdist_group("udp_mesh_logs")


class Team:
    """Three daemons, of which only Husky knows both others' addresses. None runs yet."""

    def __init__(self, folder: Path, topic: str = ARTIFACT) -> None:
        port = free_port()
        others = {"base": ["husky"], "husky": ["base", "spot"], "spot": ["husky"]}
        self.daemons = {
            name: RunningDaemon(
                folder,
                name,
                configuration(folder, name, own, [ADDRESSES[other] for other in others[name]], port, topics=topic),
            )
            for name, own in ADDRESSES.items()
        }

    def __getitem__(self, name: str) -> RunningDaemon:
        return self.daemons[name]

    def log(self, name: str) -> dict[str, object]:
        """Spot's log as one of the daemons sees it; empty if it has not heard of it."""
        with self[name].client() as client:
            logs = client.request("logs")["logs"]
        return dict(logs[0]) if logs else {}


@contextmanager
def team(topic: str = ARTIFACT) -> Iterator[Team]:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path, ExitStack() as stack:
        members = Team(Path(path), topic)
        for daemon in members.daemons.values():
            stack.callback(daemon.stop)
        yield members


def publish(daemon: RunningDaemon, *payloads: bytes) -> None:
    with daemon.client() as client:
        for payload in payloads:
            client.publish("artifact", payload)


def test_items_reach_a_base_that_their_source_never_meets() -> None:
    payloads = [b"artifact %d" % number * 1000 for number in range(12)] + [os.urandom(400_000)]
    with team() as members:
        spot, husky, base = members["spot"], members["husky"], members["base"]
        spot.start()
        publish(spot, *payloads)
        spot.kill()
        spot.start()
        husky.start()
        poll(lambda: members.log("husky").get("held_items") == 13, "husky carries the items")
        spot.kill()
        husky.kill()
        base.start()
        with base.client() as program:
            program.subscribe("artifact")
            husky.start()
            messages = collect(program, 13)
            assert sorted((message.source, message.number) for message in messages) == [
                ("spot", number) for number in range(1, 14)
            ]
            assert sorted(message.payload for message in messages) == sorted(payloads)
            spot.start()
            poll(lambda: members.log("spot").get("missing_readers") == {}, "spot knows that the base has everything")
            assert list(program.messages(0.5)) == []
        with spot.client() as client:
            shown = logs_view(client.request("logs"))
        assert "base 13" in shown


def test_a_publisher_learns_who_has_its_item() -> None:
    with team() as members:
        members["spot"].start()
        members["husky"].start()
        wait_online(members["spot"], "husky")
        with members["spot"].client() as program:
            program.request("events")
            program.publish("artifact", b"backpack", notify=True)
            frame = None
            while frame is None or frame[0].get("event") != "log-item-held":
                frame = program.next_frame(20)
                assert frame is not None
            assert (frame[0]["holder"], frame[0]["topic"], frame[0]["number"]) == ("husky", "artifact", 1)
            members["base"].start()
            assert outcomes(program, 1) == {frame[0]["message_id"]: "delivered"}


def test_items_that_no_program_took_survive_a_kill_of_the_base() -> None:
    with team() as members:
        for name in ("spot", "husky", "base"):
            members[name].start()
        publish(members["spot"], b"one", b"two")
        poll(lambda: members.log("base").get("received_items") == 2, "the base has both")
        members["base"].kill()
        members["base"].start()
        with members["base"].client() as program:
            program.subscribe("artifact", acknowledge=True)
            messages = collect(program, 2)
            assert sorted((message.payload, message.number) for message in messages) == [(b"one", 1), (b"two", 2)]
            receipts = [message.receipt for message in messages if message.receipt is not None]
            assert program.acknowledge(*receipts) == 2
        members["base"].stop()
        members["base"].start()
        with members["base"].client() as program:
            program.subscribe("artifact")
            assert list(program.messages(0.5)) == []


def test_a_damaged_database_is_set_aside_and_its_numbers_are_not_reused() -> None:
    with team() as members:
        spot = members["spot"]
        spot.start()
        publish(spot, b"before")
        spot.stop()
        database = spot.folder / "spot" / "logs" / "items.db"
        database.write_bytes(b"not a database" * 1000)
        spot.start()
        assert "log-damaged" in spot.log.read_text()
        assert list(database.parent.glob("*.damaged-*"))
        publish(spot, b"after")
        members["husky"].start()
        members["base"].start()
        with members["base"].client() as program:
            program.subscribe("artifact")
            assert [(message.payload, message.number) for message in collect(program, 1)] == [(b"after", 1)]


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small disk needs root")
def test_a_full_disk_is_reported_to_the_publisher_and_loses_nothing_accepted() -> None:
    with team() as members:
        spot = members["spot"]
        state = spot.folder / "spot"
        state.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600k", "none", str(state)], check=True)
        try:
            spot.start()
            publish(spot, b"small")
            with spot.client() as program, pytest.raises(MeshError, match=r"the log is not on disk: .*full"):
                program.publish("artifact", os.urandom(2_000_000))
            publish(spot, b"small too")
            spot.kill()
            spot.start()
            members["husky"].start()
            poll(lambda: members.log("husky").get("held_items") == 2, "husky carries what was accepted")
        finally:
            spot.stop()
            subprocess.run(["umount", str(state)], check=True)


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("runuser") is None, reason="switching the user needs root")
def test_the_log_belongs_to_the_daemons_user() -> None:
    with team() as members:
        spot = members["spot"]
        spot.folder.chmod(0o755)
        spot.write(spot.file.read_text() + '\nuser = "nobody"\n')
        spot.start()
        publish(spot, b"one")
        owner = pwd.getpwnam("nobody").pw_uid
        files = list((spot.folder / "spot" / "logs").iterdir())
        assert {path.stat().st_uid for path in files} == {owner}
        assert {path.stat().st_mode & 0o077 for path in files} == {0}
        spot.stop()
        spot.start()
        publish(spot, b"two")
        assert members.log("spot")["newest"] == 2
