"""The command line against real daemons: what scripts rely on is exit codes and JSON."""

import argparse
import errno
import io
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.udp_mesh.daemon.processes import RunningDaemon, collect, poll, two_daemons
from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh.cli import serve, traffic
from udp_mesh.cli.inspect import screen
from udp_mesh.cli.main import FORWARDED, build_parser, main
from udp_mesh.cli.output import Exit, milliseconds
from udp_mesh.client.mesh_client import FrameReader, MeshClient, MeshError, encode_frame
from udp_mesh.crypto import Key
from udp_mesh.daemon.configuration import read_keys

Pair = tuple[RunningDaemon, RunningDaemon]
Run = Callable[..., tuple[int, str, str]]

pytestmark = pytest.mark.xdist_group("udp_mesh_cli")


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with two_daemons() as daemons:
        yield daemons


@pytest.fixture
def run(pair: Pair, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command on alice; returns its exit code, output and complaints."""

    def run_command(*words: str) -> tuple[int, str, str]:
        code = main([*words, "--socket", str(pair[0].socket)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run_command


@pytest.mark.parametrize("command", ["status", "peers", "topics"])
def test_what_is_can_be_read_by_people_and_by_scripts(run: Run, command: str) -> None:
    code, text, _ = run(command)
    assert code == Exit.OK
    assert ("bob" if command != "topics" else "map") in text
    code, text, _ = run(command, "--json")
    assert code == Exit.OK
    assert isinstance(json.loads(text), dict)


def test_a_watch_repeats_until_it_is_interrupted(pair: Pair) -> None:
    words = ["status", "--watch", "0.05", "--json", "--socket", str(pair[0].socket)]
    program = subprocess.Popen([sys.executable, "-m", "udp_mesh.cli.main", *words], stdout=subprocess.PIPE)
    with program:
        assert program.stdout is not None
        uptimes = [json.loads(program.stdout.readline())["uptime_s"] for _ in range(2)]
        program.send_signal(signal.SIGINT)
        assert program.wait(WAIT_S) == Exit.OK
    assert uptimes[1] > uptimes[0]


def test_a_watched_page_keeps_to_its_terminal() -> None:
    page = "\n".join(f"{number:03} " + "x" * 100 for number in range(60))
    shown = screen(page, 40, 24).removeprefix("\x1b[H").removesuffix("\x1b[J").split("\x1b[K\n")
    assert len(shown) == 24
    assert shown[-1] == ""
    assert max(map(len, shown)) == 40
    assert shown[0].startswith("000 x")
    assert shown[-2].startswith("... 38 more lines")
    assert screen("one\ntwo", 40, 24) == "\x1b[Hone\x1b[K\ntwo\x1b[K\n\x1b[J"


@pytest.mark.parametrize("words", [["ping", "bob", "-c", "1000"], ["bench", "bob", "--seconds", "1000", "--size", "1"]])
def test_a_measurement_that_is_interrupted_says_what_it_has(pair: Pair, words: list[str]) -> None:
    code = "import sys; from udp_mesh.cli import main, traffic; print('ready', flush=True); sys.exit(main.main())"
    with subprocess.Popen(
        [sys.executable, "-c", code, *words, "--socket", str(pair[0].socket)], stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None
        program.stdout.readline()
        if words[0] == "ping":
            assert "bob: " in program.stdout.readline()
        else:
            poll(lambda: bench_arrived(pair[1]), "the benchmark's messages arrive")
        program.send_signal(signal.SIGINT)
        last = program.stdout.read().splitlines()[-1]
        assert program.wait(WAIT_S) == Exit.INTERRUPTED
    assert re.match("[1-9][0-9]* of [1-9][0-9]* (answered, least|messages of 1 B delivered)", last)


def bench_arrived(daemon: RunningDaemon) -> bool:
    with daemon.client() as client:
        return int(client.request("status")["conditions"]["counters"]["messages_received"]) > 20


def test_a_wait_that_is_interrupted_is_no_success(pair: Pair) -> None:
    words = ["ping", "bob", "-c", "1000", "--json", "--socket", str(pair[0].socket)]
    program = subprocess.Popen([sys.executable, "-m", "udp_mesh.cli.main", *words], stdout=subprocess.PIPE)
    with program:
        assert program.stdout is not None
        program.stdout.readline()
        program.send_signal(signal.SIGINT)
        assert program.wait(WAIT_S) == Exit.INTERRUPTED


@pytest.mark.parametrize("period", ["0", "-1", "nan", "inf", "soon"])
def test_a_watch_has_a_finite_period(period: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["status", f"--watch={period}"])
    assert ended.value.code == Exit.USAGE
    assert "--watch" in capsys.readouterr().err


def test_a_message_is_sent_and_its_outcome_decides_the_exit_code(run: Run, pair: Pair) -> None:
    with pair[1].client() as receiver:
        receiver.subscribe("status")
        code, text, _ = run("pub", "status", "hello", "--to", "bob", "--type", "text", "--wait", str(WAIT_S), "--json")
        assert code == Exit.OK
        assert json.loads(text)["outcome"] == "delivered"
        assert collect(receiver, 1)[0].payload == b"hello"


def test_the_outcome_at_every_destination_is_waited_for(run: Run) -> None:
    assert run("set", "topic", "orders", 'destinations=["bob", "carol"]', "deadline_s=0.2", "outbox=all")[0] == Exit.OK
    code, text, _ = run("pub", "orders", "go", "--wait", str(WAIT_S), "--json")
    told = {line["peer"]: line["outcome"] for line in map(json.loads, text.splitlines())}
    assert (code, told) == (Exit.NOT_DELIVERED, {"bob": "delivered", "carol": "expired"})
    code, text, _ = run("pub", "map", "x" * 20_000, "--wait", str(WAIT_S), "--json")
    assert (code, json.loads(text)["peer"]) == (Exit.OK, "bob")


def test_what_has_no_outcome_says_so(run: Run) -> None:
    code, text, complaint = run("pub", "video", "x", "--to", "bob", "--wait")
    assert (code, text) == (Exit.USAGE, "")
    assert "video, which is best effort" in complaint
    assert run("set", "topic", "later", 'destinations=["carol"]', "outbox=all")[0] == Exit.OK
    code, text, complaint = run("pub", "later", "x", "--wait", "0.1")
    assert (code, text) == (Exit.NOT_DELIVERED, "")
    assert "1 outcome(s) are missing after 0.1 s, of carol (one to all that fits a datagram has none" in complaint


def test_a_message_is_the_bytes_of_the_command_line(run: Run, pair: Pair) -> None:
    with pair[1].client() as receiver:
        receiver.subscribe("status")
        assert run("pub", "status", os.fsdecode(b"\xff\xfe"), "--to", "bob", "--wait")[0] == Exit.OK
        assert collect(receiver, 1)[0].payload == b"\xff\xfe"


@pytest.mark.parametrize("words", [["status"], ["status", "--json"], ["metrics"], ["ping", "bob", "-c", "1"]])
def test_an_output_that_takes_no_more_is_a_complaint(pair: Pair, words: list[str]) -> None:
    with open("/dev/full", "w") as full:
        program = subprocess.run(
            [sys.executable, "-m", "udp_mesh.cli.main", *words, "--socket", str(pair[0].socket)],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=WAIT_S,
        )
    assert (program.returncode, program.stderr) == (
        Exit.FAILED,
        "udp-mesh: standard output: No space left on device\n",
    )


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_closed_standard_stream_is_no_error_of_ours(pair: Pair, closed: str) -> None:
    words = shlex.join([sys.executable, "-m", "udp_mesh.cli.main", "status", "--socket", str(pair[0].socket)])
    program = subprocess.run(["sh", "-c", f"{words} {closed}"], capture_output=True, text=True, timeout=WAIT_S)
    assert (program.returncode, program.stderr) == (Exit.OK, "")
    words = words.replace(" status ", " pub status --to bob ")
    program = subprocess.run(["sh", "-c", f"{words} <&-"], capture_output=True, text=True, timeout=WAIT_S)
    assert program.returncode == Exit.FAILED
    assert "standard input is closed" in program.stderr


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_characters_that_the_terminal_lacks_are_shown_by_their_numbers(
    pair: Pair, form: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    alice, _ = pair
    with alice.client() as client:
        client.request("set-topic", topic="gr\u00fc\u00df", values={"priority": 5})
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    assert main(["topics", "--socket", str(alice.socket), *form]) == Exit.OK
    text = raw.getvalue().decode("ascii")
    if form:
        assert "gr\u00fc\u00df" in {topic["name"] for topic in json.loads(text)["topics"]}
    else:
        assert "gr\\xfc\\xdf" in text
    assert main(["drop", "topic", "gr\u00fc\u00df", "--socket", str(alice.socket)]) == Exit.OK


def test_the_environment_names_the_socket(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("UDP_MESH_SOCKET", str(pair[0].socket))
    assert main(["peers"]) == Exit.OK
    assert "bob" in capsys.readouterr().out
    assert main(["peers", "--socket", str(pair[0].socket) + "x"]) == Exit.UNREACHABLE


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


def test_a_script_is_told_that_its_message_was_accepted(run: Run) -> None:
    code, text, _ = run("pub", "map", "x", "--to", "bob", "--count", "2", "--rate", "100", "--json")
    assert (code, json.loads(text)) == (Exit.OK, {"topic": "map", "accepted": 2})


def test_an_undeliverable_message_has_an_exit_code_of_its_own(run: Run) -> None:
    assert run("set", "topic", "brief", "deadline_s=0.05", "rate_limit_bytes_per_s=1000")[0] == Exit.OK
    code, text, _ = run("pub", "brief", "x" * 900, "--to", "bob", "--count", "4", "--rate", "1000", "--wait")
    assert code == Exit.NOT_DELIVERED
    assert "expired bob" in text


@pytest.mark.parametrize("form", [[], ["--json"], ["--raw"]])
def test_arriving_messages_are_printed(pair: Pair, capsysbinary: pytest.CaptureFixture[bytes], form: list[str]) -> None:
    alice, bob = pair

    def send() -> None:
        with bob.client() as client:
            # The subscription may come a moment later than the first of these.
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


def test_silence_ends_an_echo_with_a_timeout(run: Run) -> None:
    assert run("echo", "nothing", "--timeout", "0.05")[0] == Exit.FAILED


def test_a_peer_answers_a_ping_and_a_stranger_does_not(run: Run) -> None:
    code, text, _ = run("ping", "bob", "--count", "2", "--interval", "0.01", "--timeout", "50", "--json")
    assert code == Exit.OK
    assert all(json.loads(line)["round_trip_s"] > 0 for line in text.splitlines())
    assert "2 of 2 answered" in run("ping", "bob", "--count", "2", "--interval", "0.01", "--timeout", "50")[1]
    code, text, complaint = run("ping", "nobody", "-c", "1000")
    assert (code, text) == (Exit.FAILED, "")
    assert "nobody was never heard of (`udp-mesh peers` lists" in complaint
    code, text, _ = run("ping", "nobody", "--json")
    assert (code, json.loads(text)) == (Exit.FAILED, {"peer": "nobody", "error": "unknown-peer"})


def test_a_ping_whose_daemon_ends_says_what_it_has(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    replies = iter([{"round_trip_s": 0.002}, {"round_trip_s": 0.004}])

    def request(*_: object, **__: object) -> dict[str, float]:
        reply = next(replies, None)
        if reply is None:
            raise MeshError("unreachable", "the daemon closed the connection")
        return reply

    monkeypatch.setattr(MeshClient, "request", request)
    code, text, complaint = run("ping", "bob", "-c", "9", "--interval", "0.001")
    assert (code, complaint) == (Exit.UNREACHABLE, "udp-mesh: the daemon closed the connection\n")
    assert text.splitlines()[-1] == "2 of 3 answered, least 2 ms, mean 3 ms, most 4 ms"


def test_a_command_that_only_asks_loads_no_transport() -> None:
    code = "import sys, udp_mesh.cli.main; print('udp_mesh.core.node' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=WAIT_S).stdout
    assert found == "False\n"


def test_a_benchmark_says_what_arrived(run: Run) -> None:
    code, text, _ = run("bench", "bob", "--seconds", "0.3", "--size", "200000", "--json")
    assert code == Exit.OK
    result = json.loads(text)
    assert result["delivered"] == result["messages"] > 0
    assert result["bits_per_s"] > 0


def test_what_is_set_shows_and_what_is_dropped_is_gone(run: Run) -> None:
    assert run("set", "topic", "video", "priority=10", "outbox=last", 'destinations=["bob"]')[0] == Exit.OK
    topics: dict[str, Any] = {topic["name"]: topic for topic in json.loads(run("topics", "--json")[1])["topics"]}
    assert (topics["video"]["priority"], topics["video"]["outbox"]) == (10, "last")
    assert topics["video"]["keep_last"] == 2
    assert run("drop", "topic", "video")[0] == Exit.OK
    assert "video" not in run("topics")[1]
    assert run("drop", "topic", "video")[0] == Exit.FAILED
    assert len(json.loads(run("set", "window", "3", "--json")[1])["changes"]) == 1
    assert run("set", "rates", "offline_s=4", "heartbeat_s=0.3")[0] == Exit.OK
    assert run("set", "neighbour", "127.0.3.9", "--name", "base")[0] == Exit.OK
    assert run("drop", "neighbour", "127.0.3.9")[0] == Exit.OK
    assert run("reload")[0] == Exit.OK
    assert run("reload")[1] == "nothing to change\n"


@pytest.mark.parametrize(
    ("words", "code", "complaint"),
    [
        (["set", "topic", "map", "priority"], Exit.USAGE, "expected key=value, found 'priority'"),
        (["set", "topic", "map", "prioriti=3"], Exit.FAILED, "did you mean 'priority'?"),
        (["set", "window", "many"], Exit.FAILED, 'expected "adaptive" or 1 to 4096'),
        (["pub", "unknown", "x"], Exit.FAILED, "unknown topic: topic unknown is not declared (`udp-mesh topics` lists"),
        (["pub", "map", "x", "--to", "nobody"], Exit.FAILED, "nobody was never heard of (`udp-mesh peers` lists"),
        (["pub", "map", "x", "--file", "map.bin"], Exit.USAGE, "expected the message or --file, found both"),
    ],
)
def test_a_mistake_is_explained_in_one_line(run: Run, words: list[str], code: int, complaint: str) -> None:
    found, _, text = run(*words)
    assert found == code
    assert complaint in text
    assert text.count("\n") == 1


def test_a_recording_is_started_and_stopped(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    assert run("record", "start", str(path))[0] == Exit.OK
    code, text, _ = run("record", "stop", "--json")
    assert code == Exit.OK
    assert json.loads(text)["path"] == str(path)
    assert run("record", "start", str(path))[::2] == (Exit.FAILED, f"udp-mesh: {path}: File exists\n")


def test_a_recording_where_the_daemon_may_not_write_or_we_cannot_look_is_told(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, _, complaint = run("record", "start", str(tmp_path / "none" / "run.jsonl"))
    assert code == Exit.FAILED
    assert "No such file or directory (the daemon writes it, and as a service may do so below" in complaint
    # a /tmp of the daemon's own: what it made there is not here
    monkeypatch.setattr(MeshClient, "request", lambda *_, **__: {})
    code, _, complaint = run("record", "start", str(tmp_path / "run.jsonl"))
    assert code == Exit.OK
    assert "run.jsonl is not to be seen here: the daemon has a /tmp of its own" in complaint


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "-"), (0.000842, "0.842 ms"), (0.34, "340 ms"), (0.9994, "999 ms"), (0.9996, "1.0 s"), (18.19, "18.2 s")],
)
def test_a_time_is_shown_in_a_unit_that_suits_it(seconds: float | None, text: str) -> None:
    assert milliseconds(seconds) == text


def test_metrics_are_printed(run: Run) -> None:
    assert "udp_mesh_peer_online" in run("metrics")[1]


@pytest.mark.parametrize(
    "words",
    [
        ["pub", "map", "x", "--count", "0"],
        ["echo", "map", "--count", "-1"],
        ["ping", "bob", "--count", "many"],
        ["bench", "bob", "--size", "0"],
        ["bench", "bob", "--size", "-5"],
        ["ping", "bob", "--interval", "soon"],
        ["ping", "bob", "--timeout", "61"],
        ["echo", "map", "--count", "\uff13"],
    ],
)
def test_a_number_that_would_do_nothing_is_wrong_usage(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == Exit.USAGE
    assert f"{words[-2]}: expected a" in capsys.readouterr().err


def test_no_daemon_has_an_exit_code_of_its_own(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["status", "--socket", str(tmp_path / "none.sock")]) == Exit.UNREACHABLE
    complaint = capsys.readouterr().err
    assert "no udp-mesh daemon at" in complaint
    assert "`udp-mesh run` starts one" in complaint


def test_a_socket_for_others_is_not_called_a_missing_daemon(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root may use every socket, so the refusal is the kernel's word in a stand-in's mouth."""

    def refused(_: socket.socket, _path: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(socket.socket, "connect", refused)
    assert main(["status", "--socket", "s"]) == Exit.UNREACHABLE
    assert "Permission denied (its socket is for root and for the group" in capsys.readouterr().err


def test_a_key_is_made_once_for_its_owner_only(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "fleet.key"
    assert main(["keygen", str(path)]) == Exit.OK
    (key,) = read_keys(path)
    assert isinstance(key, Key)
    assert path.stat().st_mode & 0o777 == 0o600
    assert key.secret.hex() not in capsys.readouterr().out
    assert main(["keygen", str(path)]) == Exit.FAILED


def test_a_configuration_is_checked_for_people_and_for_scripts(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    main(["keygen", str(tmp_path / "fleet.key")])
    path = tmp_path / "mesh.toml"
    path.write_text('name = "ugv1"\nkey_file = "fleet.key"\n[topics]\nvideo = { priority = 9 }\n')
    capsys.readouterr()
    assert main(["check", str(path)]) == Exit.OK
    assert f"{path}: good: ugv1, port 8700, 1 topics, 1 key(s)" in capsys.readouterr().out
    assert main(["check", str(path), "--json"]) == Exit.OK
    assert json.loads(capsys.readouterr().out)["topics"][0]["name"] == "video"
    path.write_text('key_file = "fleet.key"\nport = 0\nwindo = 3\n')
    assert main(["check", str(path)]) == Exit.CONFIGURATION
    assert capsys.readouterr().err.count(f"{path}:") == 2
    assert main(["check", str(path), "--json"]) == Exit.CONFIGURATION
    assert [problem["line"] for problem in json.loads(capsys.readouterr().out)["problems"]] == [2, 3]
    assert main(["run", str(path)]) == Exit.CONFIGURATION


def test_every_command_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    build_parser().print_help()
    text = capsys.readouterr().out
    commands = ["run", "check", "keygen", "status", "peers", "topics", "events", "metrics", "set", "drop", "reload"]
    for command in [*commands, "pub", "echo", "ping", "bench", "record", "report", "sim"]:
        assert f"\n    {command} " in text
    with pytest.raises(SystemExit) as caught:
        main(["dance"])
    assert caught.value.code == Exit.USAGE


def _commands(parser: argparse.ArgumentParser, *words: str) -> Iterator[tuple[str, ...]]:
    """Every command below a parser, as the words that call it."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not groups:
        yield words
    for group in groups:
        yield from (found for name, below in group.choices.items() for found in _commands(below, *words, name))


@pytest.mark.parametrize("words", sorted(_commands(build_parser())))
def test_every_command_shows_an_example_that_it_would_take(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main([*words, "--help"])
    assert caught.value.code == 0
    *_, example = capsys.readouterr().out.rstrip().splitlines()
    assert example.startswith(f"example: udp-mesh {' '.join(words)}")
    if words[0] not in FORWARDED:
        build_parser().parse_args(shlex.split(example.removeprefix("example: udp-mesh ")))


@pytest.mark.parametrize(
    ("daemon", "complaint"),
    [
        ('user = "nobody-here"', "daemon.user: expected a user of this machine, found 'nobody-here'"),
        ('socket_group = "no-such-group"', "daemon.socket_group: expected a group of this machine"),
    ],
)
def test_a_daemon_that_cannot_start_says_why(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, daemon: str, complaint: str
) -> None:
    path = tmp_path / "mesh.toml"
    path.write_text(
        f'unkeyed = true\n[[links]]\ninterface = "none0"\n[daemon]\nsocket = "{tmp_path}/s"\n'
        f'state_directory = "{tmp_path}/state"\n{daemon}\n'
    )
    assert main(["run", str(path)]) == Exit.FAILED
    assert f"udp-mesh: cannot start: {complaint}" in capsys.readouterr().err


def test_a_directory_that_is_not_ours_is_named_with_the_way_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "mesh.toml"
    (tmp_path / "file").touch()
    path.write_text(f'unkeyed = true\n[daemon]\nsocket = "{tmp_path}/file/s"\nstate_directory = "{tmp_path}"\n')
    assert main(["run", str(path)]) == Exit.FAILED
    assert f"cannot start: {tmp_path}/file" in capsys.readouterr().err
    assert serve._reason(PermissionError(errno.EACCES, "Permission denied", "/run/udp-mesh")) == (
        "/run/udp-mesh: Permission denied (`socket` and `state_directory` in [daemon] name other places)"
    )


def test_events_are_printed_until_the_daemon_ends(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A stand-in for a daemon that ends right after one event: the command says so and exits."""
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                (request,) = FrameReader().feed(connection.recv(1000))
                reply = encode_frame({"id": request[0]["id"], "ok": True})
                connection.sendall(reply + encode_frame({"event": "peer-online", "peer": "bob"}))

        server = threading.Thread(target=serve)
        server.start()
        assert main(["events", "--socket", str(path)]) == Exit.UNREACHABLE
        server.join()
    assert capsys.readouterr().out == "peer-online peer=bob\n"


@pytest.mark.parametrize(
    ("size_bytes", "delivered_per_s", "messages"),
    [(200_000, 0.0, 4), (200_000, 0.6, 4), (200_000, 5.0, 10), (200_000, 600.0, 83), (100_000_000, 1.0, 4)],
)
def test_a_benchmark_keeps_little_more_under_way_than_soon_arrives(
    size_bytes: int, delivered_per_s: float, messages: int
) -> None:
    assert traffic._backlog(size_bytes, delivered_per_s) == messages
