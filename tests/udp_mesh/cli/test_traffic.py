"""`pub`, `echo`, `ping`, `bench`, `record` with real daemons: output and exit codes."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.processes import killed_on_failure
from tests.udp_mesh.cli.conftest import Pair, Run
from tests.udp_mesh.daemon.processes import RunningDaemon, collect, poll
from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh.cli import traffic
from udp_mesh.cli.main import main
from udp_mesh.cli.output import Exit
from udp_mesh.client.mesh_client import MeshClient, MeshError

pytestmark = pytest.mark.xdist_group("udp_mesh_traffic")


@pytest.mark.parametrize("words", [["ping", "bob", "-c", "1000"], ["bench", "bob", "--seconds", "1000", "--size", "1"]])
def test_an_interrupted_measurement_prints_its_partial_result(pair: Pair, words: list[str]) -> None:
    before = messages_received(pair[1])
    command = [sys.executable, "-m", "udp_mesh.cli.main", *words, "--socket", str(pair[0].socket)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program, killed_on_failure(program):
        assert program.stdout is not None
        if words[0] == "ping":
            assert "bob: " in program.stdout.readline()
        else:
            poll(lambda: messages_received(pair[1]) > before + 20, "the benchmark's messages arrive")
        program.send_signal(signal.SIGINT)
        last = program.stdout.read().splitlines()[-1]
        assert program.wait(WAIT_S) == Exit.INTERRUPTED
    assert re.match("[1-9][0-9]* of [1-9][0-9]* (answered, min|messages of 1 B delivered)", last)


def messages_received(daemon: RunningDaemon) -> int:
    with daemon.client() as client:
        return int(client.request("status")["conditions"]["counters"]["messages_received"])


def test_an_interrupted_ping_exits_with_interrupted(pair: Pair) -> None:
    words = ["ping", "bob", "-c", "1000", "--json", "--socket", str(pair[0].socket)]
    program = subprocess.Popen([sys.executable, "-m", "udp_mesh.cli.main", *words], stdout=subprocess.PIPE)
    with program, killed_on_failure(program):
        assert program.stdout is not None
        program.stdout.readline()
        program.send_signal(signal.SIGINT)
        assert program.wait(WAIT_S) == Exit.INTERRUPTED


def test_a_message_is_sent_and_its_outcome_decides_the_exit_code(run: Run, pair: Pair) -> None:
    with pair[1].client() as receiver:
        receiver.subscribe("status")
        code, text, _ = run("pub", "status", "hello", "--to", "bob", "--type", "text", "--wait", str(WAIT_S), "--json")
        assert code == Exit.OK
        assert json.loads(text)["outcome"] == "delivered"
        assert collect(receiver, 1)[0].payload == b"hello"


def test_pub_wait_waits_for_the_outcome_of_every_destination(run: Run) -> None:
    assert run("set", "topic", "orders", 'destinations=["bob", "carol"]', "deadline_s=0.2", "outbox=all")[0] == Exit.OK
    code, text, _ = run("pub", "orders", "go", "--wait", str(WAIT_S), "--json")
    outcomes = {line["peer"]: line["outcome"] for line in map(json.loads, text.splitlines())}
    assert (code, outcomes) == (Exit.NOT_DELIVERED, {"bob": "delivered", "carol": "expired"})
    code, text, _ = run("pub", "map", "x" * 20_000, "--wait", str(WAIT_S), "--json")
    assert (code, json.loads(text)["peer"]) == (Exit.OK, "bob")


def test_waiting_for_a_message_without_an_outcome_is_reported(run: Run) -> None:
    code, text, complaint = run("pub", "video", "x", "--to", "bob", "--wait")
    assert (code, text) == (Exit.USAGE, "")
    assert "video is best effort" in complaint
    assert run("set", "topic", "later", 'destinations=["carol"]', "outbox=all")[0] == Exit.OK
    code, text, complaint = run("pub", "later", "x", "--wait", "0.1")
    assert (code, text) == (Exit.NOT_DELIVERED, "")
    expected = "timed out after 0.1 s: 1 outcome(s) missing from carol (a single-datagram broadcast has no outcome"
    assert expected in complaint


def test_a_non_utf8_message_argument_is_sent_as_raw_bytes(run: Run, pair: Pair) -> None:
    with pair[1].client() as receiver:
        receiver.subscribe("status")
        assert run("pub", "status", os.fsdecode(b"\xff\xfe"), "--to", "bob", "--wait")[0] == Exit.OK
        assert collect(receiver, 1)[0].payload == b"\xff\xfe"


def test_a_file_is_sent_several_times(run: Run, pair: Pair, tmp_path: Path) -> None:
    (tmp_path / "map.bin").write_bytes(b"\x00map")
    with pair[1].client() as receiver:
        receiver.subscribe("map")
        words = ["pub", "map", "--file", str(tmp_path / "map.bin"), "--to", "bob", "--count", "3", "--rate", "100"]
        assert run(*words)[0] == Exit.OK
        assert [message.payload for message in collect(receiver, 3)] == [b"\x00map"] * 3
    code, _, complaint = run("pub", "map", "--file", str(tmp_path / "missing"))
    assert code == Exit.FAILED
    assert "missing: No such file" in complaint


@pytest.mark.parametrize("words", [["--file", "/dev/zero"], ["-"]])
def test_an_endless_file_is_rejected_as_a_message(run: Run, monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    monkeypatch.setattr(traffic, "MAX_PAYLOAD_BYTES", 1000)
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(bytes(2000))))
    code, _, complaint = run("pub", "status", *words, "--to", "bob")
    name = "standard input" if words == ["-"] else "/dev/zero"
    assert (code, complaint) == (Exit.FAILED, f"udp-mesh: {name}: expected at most 1000 bytes, found more\n")


def test_pub_json_reports_accepted_messages(run: Run) -> None:
    code, text, _ = run("pub", "map", "x", "--to", "bob", "--count", "2", "--rate", "100", "--json")
    assert (code, json.loads(text)) == (Exit.OK, {"topic": "map", "accepted": 2})


def test_an_undeliverable_message_has_its_own_exit_code(run: Run) -> None:
    assert run("set", "topic", "brief", "deadline_s=0.05", "rate_limit_bytes_per_s=1000")[0] == Exit.OK
    code, text, _ = run("pub", "brief", "x" * 900, "--to", "bob", "--count", "4", "--rate", "1000", "--wait")
    assert code == Exit.NOT_DELIVERED
    assert "expired bob" in text


@pytest.mark.parametrize("form", [[], ["--json"], ["--raw"]])
def test_arriving_messages_are_printed(pair: Pair, capsysbinary: pytest.CaptureFixture[bytes], form: list[str]) -> None:
    alice, bob = pair

    def send() -> None:
        with bob.client() as client:
            # The subscription may be later than the first of these.
            while not done.wait(0.1):
                client.publish("status", b"ready", to="alice")

    done = threading.Event()
    sender = threading.Thread(target=send)
    sender.start()
    try:
        words = ["echo", "status", "--count", "1", "--timeout", str(WAIT_S), "--socket", str(alice.socket), *form]
        assert main(words) == Exit.OK
    finally:
        done.set()
        sender.join()
    text = capsysbinary.readouterr().out
    if form == ["--raw"]:
        assert text == b"ready"
    elif form:
        assert json.loads(text)["payload"] == "cmVhZHk="
    else:
        assert text == b"bob status p0 5 B  ready\n"


@pytest.mark.parametrize("words", [["-"], [], ["--file", "-"]])
def test_a_message_is_read_from_standard_input(pair: Pair, monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    alice, bob = pair
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"piped")))
    with bob.client() as client:
        client.subscribe("status")
        assert main(["pub", "status", *words, "--to", "bob", "--wait", "--socket", str(alice.socket)]) == Exit.OK
        (message,) = collect(client, 1)
    assert message.payload == b"piped"


def test_echo_times_out_without_messages(run: Run) -> None:
    assert run("echo", "nothing", "--timeout", "0.05")[0] == Exit.FAILED


def test_ping_succeeds_for_a_peer_and_fails_for_an_unknown_one(run: Run) -> None:
    code, text, _ = run("ping", "bob", "--count", "2", "--interval", "0.01", "--timeout", "50", "--json")
    assert code == Exit.OK
    assert all(json.loads(line)["round_trip_s"] > 0 for line in text.splitlines())
    assert "2 of 2 answered" in run("ping", "bob", "--count", "2", "--interval", "0.01", "--timeout", "50")[1]
    code, text, complaint = run("ping", "nobody", "-c", "1000")
    assert (code, text) == (Exit.FAILED, "")
    assert "nobody is not a known peer (run `udp-mesh peers` for" in complaint
    code, text, _ = run("ping", "nobody", "--json")
    assert (code, json.loads(text)) == (Exit.FAILED, {"peer": "nobody", "error": "unknown-peer"})


def test_ping_prints_its_partial_result_when_the_daemon_exits(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    replies = iter([{"round_trip_s": 0.002}, {"round_trip_s": 0.004}])

    def request(*_: object, **__: object) -> dict[str, float]:
        reply = next(replies, None)
        if reply is None:
            raise MeshError("unreachable", "the daemon closed the connection")
        return reply

    monkeypatch.setattr(MeshClient, "request", request)
    code, text, complaint = run("ping", "bob", "-c", "9", "--interval", "0.001")
    assert (code, complaint) == (Exit.UNREACHABLE, "udp-mesh: the daemon closed the connection\n")
    assert text.splitlines()[-1] == "2 of 3 answered, min 2 ms, mean 3 ms, max 4 ms"


def test_a_benchmark_reports_delivered_messages_and_throughput(run: Run) -> None:
    code, text, _ = run("bench", "bob", "--seconds", "0.3", "--size", "200000", "--json")
    assert code == Exit.OK
    result = json.loads(text)
    assert result["delivered"] == result["messages"] > 0
    assert result["bits_per_s"] > 0


def test_a_recording_is_started_and_stopped(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    assert run("record", "start", str(path))[0] == Exit.OK
    code, text, _ = run("record", "stop", "--json")
    assert code == Exit.OK
    assert json.loads(text)["path"] == str(path)
    assert run("record", "start", str(path))[::2] == (Exit.FAILED, f"udp-mesh: {path}: File exists\n")


def test_a_recording_that_cannot_be_written_or_found_is_reported(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, _, complaint = run("record", "start", str(tmp_path / "none" / "run.jsonl"))
    assert code == Exit.FAILED
    assert "No such file or directory (the daemon writes the file; as a service it may do so only below" in complaint
    # A private /tmp of the daemon: its files are not visible here.
    monkeypatch.setattr(MeshClient, "request", lambda *_, **__: {})
    code, _, complaint = run("record", "start", str(tmp_path / "run.jsonl"))
    assert code == Exit.OK
    assert "run.jsonl is not visible here: the daemon's service has a private /tmp" in complaint


@pytest.mark.parametrize(
    ("size_bytes", "delivered_per_s", "messages"),
    [(200_000, 0.0, 4), (200_000, 0.6, 4), (200_000, 5.0, 10), (200_000, 600.0, 83), (100_000_000, 1.0, 4)],
)
def test_a_benchmark_backlog_scales_with_the_delivery_rate(
    size_bytes: int, delivered_per_s: float, messages: int
) -> None:
    assert traffic._backlog(size_bytes, delivered_per_s) == messages
