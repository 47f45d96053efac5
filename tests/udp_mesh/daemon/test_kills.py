"""Daemons killed, restarted and reloaded during transfers: every accepted message is delivered or has an outcome."""

import signal
import socket
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.udp_mesh.daemon.disks import standing_disk
from tests.udp_mesh.daemon.processes import (
    KEY,
    OTHER_KEY,
    RunningDaemon,
    collect,
    configuration,
    outcomes,
    poll,
    two_daemons,
    wait_online,
)
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh.client import MeshClient, MeshError

pytestmark = pytest.mark.xdist_group("udp_mesh_kills")

ARTIFACT = bytes(range(251)) * 20_000
"""5 MB: long enough in flight to be killed in the middle."""


def test_a_receiver_killed_in_the_middle_gets_the_message_after_its_restart() -> None:
    with two_daemons() as (alice, bob), alice.client() as sender:
        numbers = [sender.publish("map", ARTIFACT, to="bob", notify=True) for _ in range(4)]
        bob.kill()
        bob.start()
        with bob.client() as receiver:
            receiver.subscribe("map")
            ends = outcomes(sender, 4)
            assert ends == dict.fromkeys(numbers, "delivered")
            # The first ones may have been delivered before the kill; the last one cannot have been.
            assert collect(receiver, 1)[0].payload == ARTIFACT


def test_messages_on_disk_are_delivered_after_a_killed_sender_restarts() -> None:
    topics = 'log = { priority = 8, outbox = "all", outbox_on_disk = true }'
    with two_daemons(topics) as (alice, bob):
        bob.stop()
        wait_online(alice, "bob", online=False)
        with alice.client() as sender:
            for number in range(10):
                sender.publish("log", b"entry %d" % number, to="bob")
        alice.kill()
        with bob, bob.client() as receiver:
            receiver.subscribe("log")
            alice.start()
            entries = {message.payload for message in collect(receiver, 10)}
    assert entries == {b"entry %d" % number for number in range(10)}


def test_a_hung_disk_delays_only_the_publishers_that_wait_for_it() -> None:
    topics = 'log = { priority = 8, outbox = "all", outbox_on_disk = true }'
    with (
        two_daemons(topics) as (alice, bob),
        standing_disk(alice.folder / "alice" / "outbox", 0) as go_on,
        alice.client() as first,
        alice.client() as patient,
        alice.client() as sender,
        bob.client() as receiver,
    ):
        receiver.subscribe("log", "status")
        with ThreadPoolExecutor(2) as waiting:
            # Carol never comes, so this message has to be written. A message that is delivered before its write
            # begins need not be, and would not find the disk hung.
            for_carol = waiting.submit(first.publish, "log", b"entry", to="carol")
            poll(lambda: messages_held_for(sender, "carol") == 1, "the message to carol")
            answer = waiting.submit(patient.publish, "log", b"entry", to="bob", notify=True)
            assert collect(receiver, 1)[0].payload == b"entry"
            sender.publish("status", b"now", to="bob")
            assert collect(receiver, 1)[0].payload == b"now"
            assert not for_carol.done()
            assert not answer.done()
            go_on()
            for_carol.result(WAIT_S)
            # a client is one thread's at a time
            number = answer.result(WAIT_S)
            assert outcomes(patient, 1) == {number: "delivered"}


def messages_held_for(client: MeshClient, peer: str) -> int:
    peers = client.request("peers")["peers"]
    return sum(found["outbox_messages"] for found in peers if found["name"] == peer)


def priority_of(operator: MeshClient, name: str) -> int | None:
    topics = operator.request("topics")["topics"]
    return next((topic["priority"] for topic in topics if topic["name"] == name), None)


def test_a_reload_under_load_drops_nothing() -> None:
    with two_daemons() as (alice, bob), alice.client() as sender, bob.client() as receiver, alice.client() as operator:
        receiver.subscribe("map", "extra")
        text = alice.file.read_text()
        numbers = []
        for turn in range(10):
            numbers += [sender.publish("map", bytes([turn]) * 60_000, to="bob", notify=True) for _ in range(4)]
            alice.write(text.replace("[topics]", f"[topics]\nextra = {{ priority = {turn} }}"))
            if turn % 2:
                alice.signal(signal.SIGHUP)
                poll(lambda turn=turn: priority_of(operator, "extra") == turn, "the reload")  # type: ignore[misc]
            else:
                assert any("extra" in change for change in operator.request("reload")["changes"])
        numbers.append(sender.publish("extra", b"new topic", to="bob", notify=True))
        assert outcomes(sender, len(numbers)) == dict.fromkeys(numbers, "delivered")
        assert len(collect(receiver, len(numbers))) == 41


def test_reloading_an_invalid_file_changes_nothing_and_reports_the_line() -> None:
    with two_daemons() as (alice, _), alice.client() as operator:
        before = operator.request("topics")["topics"]
        text = alice.file.read_text()
        alice.write(text.replace("priority = 7", "priority = 77"))
        with pytest.raises(MeshError, match=r"alice.toml:\d+: topics.map.priority: expected an integer from 0 to 15"):
            operator.request("reload")
        alice.signal(signal.SIGHUP)
        poll(lambda: "reload-refused" in alice.log.read_text(), "the refusal is logged")
        assert operator.request("topics")["topics"] == before
        alice.write(text.replace('name = "alice"', 'name = "carol"'))
        assert operator.request("reload")["changes"] == ["name: takes effect after a restart"]


def test_keys_are_rotated_through_two_live_keys_without_losing_a_message() -> None:
    with two_daemons() as (alice, bob), alice.client() as sender, bob.client() as receiver:
        receiver.subscribe("map")
        numbers = []
        for keys in ((KEY, OTHER_KEY), (OTHER_KEY, KEY), (OTHER_KEY,)):
            for daemon in (alice, bob):
                (daemon.folder / f"{daemon.name}.key").write_text("\n".join(keys))
                numbers += [sender.publish("map", bytes(100_000), to="bob", notify=True) for _ in range(3)]
                with daemon.client() as operator:
                    assert operator.request("reload")["changes"]
                    assert len(operator.request("status")["keys"]) == len(keys)
        assert outcomes(sender, len(numbers)) == dict.fromkeys(numbers, "delivered")
        assert len(collect(receiver, len(numbers))) == len(numbers)


def test_nodes_with_different_keys_report_a_key_mismatch_and_do_not_peer() -> None:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder, port = Path(path), free_port()
        alice = RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [2], port))
        mallory = RunningDaemon(folder, "mallory", configuration(folder, "mallory", 2, [1], port, keys=(OTHER_KEY,)))
        with alice, mallory:
            poll(lambda: "key-mismatch address=127.0.3.2" in alice.log.read_text(), "the foreign key is reported")
            with alice.client() as client:
                assert client.request("peers")["peers"] == []


def test_systemd_is_notified_of_readiness_watchdog_reload_and_stop() -> None:
    with (
        tempfile.TemporaryDirectory(prefix="udp-mesh-") as path,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd,
    ):
        folder = Path(path)
        systemd.bind(str(folder / "notify"))
        systemd.settimeout(WAIT_S)
        alice = RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [2], free_port()))
        alice.environment = {"NOTIFY_SOCKET": str(folder / "notify"), "WATCHDOG_USEC": "200000"}

        def hear(word: str) -> str:
            while True:
                text = systemd.recv(1000).decode()
                if text.startswith(word):
                    return text

        with alice:
            assert "alice: 0 of 0 peers online" in hear("READY=1")
            hear("WATCHDOG=1")
            hear("WATCHDOG=1")
            alice.signal(signal.SIGHUP)
            hear("RELOADING=1")
            hear("READY=1")
            assert alice.stop() == 0
        hear("STOPPING=1")
        assert not alice.socket.exists()
        assert "Traceback" not in alice.log.read_text()


def test_a_second_daemon_does_not_take_the_firsts_socket_port_or_files() -> None:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder = Path(path)
        first = RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [2], free_port()))
        with first:
            outbox = folder / "alice" / "outbox"
            outbox.mkdir(parents=True, exist_ok=True)
            being_written, kept = outbox / f"{7:020d}.new", outbox / f"{6:020d}.message"
            being_written.write_bytes(b"half of")
            kept.write_bytes(b"not all of it is on this disk")
            second = _run_to_end(first.file)
            assert second.returncode == 1
            assert f"cannot start: {first.socket}: another daemon is already listening" in second.stderr
            assert "Traceback" not in second.stderr
            assert being_written.exists()
            assert kept.exists()
            with first.client() as client:
                client.request("peers")


def test_a_second_daemon_does_not_use_the_firsts_state_directory() -> None:
    """It would send the messages of the first one's outbox again, and delete files that are being written."""
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder, port = Path(path), free_port()
        state = folder / "alice"
        text = configuration(folder, "bob", 2, [1], port).replace(f'"{folder / "bob"}"', f'"{state}"')
        bob = RunningDaemon(folder, "bob", text)
        with RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [2], port)) as alice:
            second = _run_to_end(bob.file)
            assert second.returncode == 1
            assert (
                f"cannot start: {state}: in use by another daemon or program (change `state_directory` in [daemon])"
                in second.stderr
            )
            assert not bob.socket.exists()
            with alice.client() as client:
                client.request("peers")
            alice.kill()
            with bob:
                assert bob.socket.exists()


def _run_to_end(file: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "udp_mesh.cli.main", "run", str(file)],
        check=False,
        capture_output=True,
        text=True,
        timeout=WAIT_S,
    )


def test_a_daemon_starts_without_a_usable_state_directory() -> None:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder = Path(path)
        (folder / "alice").write_text("a file where the directory should be")
        alice = RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [2], free_port()))
        with alice, alice.client() as client:
            client.request("peers")


def test_a_socket_left_by_a_killed_daemon_is_replaced() -> None:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder = Path(path)
        daemon = RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [2], free_port()))
        with daemon:
            daemon.kill()
            assert daemon.socket.exists()
            daemon.start()
            assert daemon.stop() == 0
