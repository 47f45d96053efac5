"""The command line with real daemons: exit codes, JSON and messages."""

import argparse
import errno
import io
import json
import random
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.udp_mesh.cli.conftest import Pair, Run
from tests.udp_mesh.daemon.processes import RunningDaemon, configuration, outcomes
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh.cli import serve
from udp_mesh.cli.inspect import screen_text
from udp_mesh.cli.main import FORWARDED, build_parser, main
from udp_mesh.cli.output import Exit, milliseconds
from udp_mesh.client.mesh_client import FrameReader, encode_frame
from udp_mesh.crypto import Key
from udp_mesh.daemon.configuration import read_keys

pytestmark = pytest.mark.xdist_group("udp_mesh_cli")


@pytest.mark.parametrize("command", ["status", "peers", "topics"])
def test_state_is_printed_as_text_and_json(run: Run, command: str) -> None:
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


def test_a_watch_waits_for_a_daemon_that_restarts() -> None:
    with (
        tempfile.TemporaryDirectory(prefix="udp-mesh-") as folder,
        RunningDaemon(Path(folder), "alone", configuration(Path(folder), "alone", 1, [2], free_port())) as daemon,
    ):
        words = ["status", "--watch", "0.05", "--socket", str(daemon.socket)]
        program = subprocess.Popen(
            [sys.executable, "-m", "udp_mesh.cli.main", *words], stdout=subprocess.PIPE, text=True
        )
        with program:
            assert program.stdout is not None
            lines = iter(program.stdout.readline, "")
            assert next(lines).startswith("alone  udp-mesh")
            daemon.stop()
            assert any(line.endswith("; waiting for the daemon\n") for line in lines)
            daemon.start()
            assert any(line.startswith("alone  udp-mesh") for line in lines)
            program.send_signal(signal.SIGINT)
            for _ in lines:
                pass
            assert program.wait(WAIT_S) == Exit.OK


def test_watch_output_is_clipped_to_the_terminal_size() -> None:
    page = "\n".join(f"{number:03} " + "x" * 100 for number in range(60))
    shown = screen_text(page, 40, 24).removeprefix("\x1b[H").removesuffix("\x1b[J").split("\x1b[K\n")
    assert len(shown) == 24
    assert shown[-1] == ""
    assert max(map(len, shown)) == 40
    assert shown[0].startswith("000 x")
    assert shown[-2].startswith("... 38 more lines")
    assert screen_text("one\ntwo", 40, 24) == "\x1b[Hone\x1b[K\ntwo\x1b[K\n\x1b[J"


@pytest.mark.parametrize("period", ["0", "-1", "nan", "inf", "soon"])
def test_an_invalid_watch_interval_is_a_usage_error(period: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["status", f"--watch={period}"])
    assert ended.value.code == Exit.USAGE
    assert "--watch" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["status"], ["status", "--json"], ["metrics"], ["ping", "bob", "-c", "1"]])
def test_a_full_output_device_is_reported_as_an_error(pair: Pair, words: list[str]) -> None:
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
def test_closed_standard_streams_are_tolerated_unless_needed(pair: Pair, closed: str) -> None:
    words = shlex.join([sys.executable, "-m", "udp_mesh.cli.main", "status", "--socket", str(pair[0].socket)])
    program = subprocess.run(["sh", "-c", f"{words} {closed}"], capture_output=True, text=True, timeout=WAIT_S)
    assert (program.returncode, program.stderr) == (Exit.OK, "")
    words = words.replace(" status ", " pub status --to bob ")
    program = subprocess.run(["sh", "-c", f"{words} <&-"], capture_output=True, text=True, timeout=WAIT_S)
    assert program.returncode == Exit.FAILED
    assert "standard input is closed" in program.stderr


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_unencodable_characters_are_shown_as_escapes(
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


def test_the_socket_path_is_read_from_the_environment(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("UDP_MESH_SOCKET", str(pair[0].socket))
    assert main(["peers"]) == Exit.OK
    assert "bob" in capsys.readouterr().out
    assert main(["peers", "--socket", str(pair[0].socket) + "x"]) == Exit.UNREACHABLE


def test_the_cli_module_does_not_import_the_transport() -> None:
    code = "import sys, udp_mesh.cli.main; print('udp_mesh.core.endpoint' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=WAIT_S).stdout
    assert found == "False\n"


def test_set_and_drop_take_effect(run: Run) -> None:
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
    assert run("reload")[1] == "no changes\n"


def test_versions_of_a_topic_are_shown_as_text_json_and_metrics(pair: Pair, run: Run) -> None:
    alice, bob = pair
    grid = random.Random(2).randbytes(5000)
    assert run("set", "topic", "grid", "delta=true", "delta_bytes=20000")[0] == Exit.OK
    with alice.client() as client, bob.client() as reader:
        reader.subscribe("grid")
        for number in range(3):
            client.publish("grid", grid + bytes([number]) * 40, to="bob", notify=True)
            assert set(outcomes(client, 1).values()) == {"delivered"}

    def shown(daemon: RunningDaemon) -> dict[str, Any]:
        with daemon.client() as client:
            return next(topic for topic in client.request("topics")["topics"] if topic["name"] == "grid")

    sent, received = shown(alice), shown(bob)["versions"]
    assert (sent["delta"], sent["delta_bytes"]) == (True, 20_000)
    assert (sent["versions"]["whole_sent"], sent["versions"]["differences_sent"]) == (1, 2)
    assert sent["versions"]["payload_bytes_sent"] == 3 * 5040
    assert sent["versions"]["body_bytes_sent"] < 5040 + 500
    assert (received["whole_received"], received["differences_received"]) == (1, 2)
    assert received["body_bytes_received"] == sent["versions"]["body_bytes_sent"]
    topics = {topic["name"]: topic for topic in json.loads(run("topics", "--json")[1])["topics"]}
    assert (topics["grid"]["versions"], topics["map"]["versions"]) == (sent["versions"], None)
    lines = run("topics")[1].splitlines()
    (head,) = (number for number, line in enumerate(lines) if line.startswith("versions of"))
    assert lines[head + 1].split()[:3] == ["grid", "1", "2"]
    metrics = run("metrics")[1].splitlines()
    assert 'udp_mesh_version_whole_sent_total{topic="grid"} 1' in metrics
    assert 'udp_mesh_version_differences_sent_total{topic="grid"} 2' in metrics
    assert run("drop", "topic", "grid")[0] == Exit.OK


def test_a_topic_limit_can_be_removed(run: Run) -> None:
    assert run("set", "topic", "bound", "deadline_s=2", "keep_last=3", "outbox=last")[0] == Exit.OK
    code, text, _ = run("set", "topic", "bound", "deadline_s=none", "outbox=none")
    assert (code, text) == (Exit.OK, "topic bound: deadline_s 2.0 -> none\ntopic bound: outbox last -> none\n")
    (bound,) = (topic for topic in json.loads(run("topics", "--json")[1])["topics"] if topic["name"] == "bound")
    assert (bound["deadline_s"], bound["keep_last"], bound["outbox"]) == (None, 3, "none")


@pytest.mark.parametrize(
    ("words", "code", "complaint"),
    [
        (["set", "topic", "map", "priority"], Exit.USAGE, "expected key=value, found 'priority'"),
        (["set", "topic", "map", "prioriti=3"], Exit.FAILED, "did you mean 'priority'?"),
        (["set", "window", "many"], Exit.FAILED, 'expected "adaptive" or 1 to 4096'),
        (
            ["pub", "unknown", "x"],
            Exit.FAILED,
            "unknown topic: topic unknown is not declared (run `udp-mesh topics` for",
        ),
        (["pub", "map", "x", "--to", "nobody"], Exit.FAILED, "nobody is not a known peer (run `udp-mesh peers` for"),
        (["pub", "map", "x", "--file", "map.bin"], Exit.USAGE, "expected either a message or --file, found both"),
    ],
)
def test_a_mistake_is_explained_in_one_line(run: Run, words: list[str], code: int, complaint: str) -> None:
    found, _, text = run(*words)
    assert found == code
    assert complaint in text
    assert text.count("\n") == 1


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "-"), (0.000842, "0.842 ms"), (0.34, "340 ms"), (0.9994, "999 ms"), (0.9996, "1.0 s"), (18.19, "18.2 s")],
)
def test_a_duration_is_shown_in_a_suitable_unit(seconds: float | None, text: str) -> None:
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
def test_an_invalid_number_is_a_usage_error(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == Exit.USAGE
    assert f"{words[-2]}: expected a" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["east", "2"], ["1", "nan"], ["1", "2", "inf"], ["12,5", "2"]])
def test_a_position_is_of_numbers(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["set", "position", *words])
    assert ended.value.code == Exit.USAGE
    assert "expected a number of meters, such as 12.5, found '" in capsys.readouterr().err


def test_a_missing_daemon_has_its_own_exit_code(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["status", "--socket", str(tmp_path / "none.sock")]) == Exit.UNREACHABLE
    complaint = capsys.readouterr().err
    assert "cannot connect to the daemon at" in complaint
    assert "start it with `udp-mesh run`" in complaint


def test_a_socket_without_permission_is_not_reported_as_a_missing_daemon(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root may use every socket, so the kernel's error is simulated."""

    def refused(_: socket.socket, _path: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(socket.socket, "connect", refused)
    assert main(["status", "--socket", "s"]) == Exit.UNREACHABLE
    assert "Permission denied (run as root or as a member of the group" in capsys.readouterr().err


def test_keygen_writes_an_owner_only_key_and_never_overwrites_it(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "fleet.key"
    assert main(["keygen", str(path)]) == Exit.OK
    (key,) = read_keys(path)
    assert isinstance(key, Key)
    assert path.stat().st_mode & 0o777 == 0o600
    assert key.secret.hex() not in capsys.readouterr().out
    assert main(["keygen", str(path)]) == Exit.FAILED
    assert "choose another file" in capsys.readouterr().err


def test_check_reports_configuration_errors_as_text_and_json(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    main(["keygen", str(tmp_path / "fleet.key")])
    path = tmp_path / "mesh.toml"
    path.write_text('name = "ugv1"\nkey_file = "fleet.key"\n[topics]\nvideo = { priority = 9 }\n')
    capsys.readouterr()
    assert main(["check", str(path)]) == Exit.OK
    assert f"{path}: valid: ugv1, port 8700, 1 topic, 1 key" in capsys.readouterr().out
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
        # the first name of each is the present one
        names = {id(below): name for name, below in reversed(group.choices.items())}
        yield from (found for name in names.values() for found in _commands(group.choices[name], *words, name))


@pytest.mark.parametrize(
    ("words", "meant"),
    [(["statu"], "'status'"), (["recrod", "start", "x"], "'record'"), (["run", "--log-level", "deubg"], "'debug'")],
)
def test_an_unknown_word_gets_the_nearest_known_one(
    words: list[str], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith(f"; did you mean {meant}?\n")


def test_options_before_the_command_are_answered_with_the_right_order(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--socket", "/run/x y", "status", "--json"])
    assert ended.value.code == Exit.USAGE
    assert "options follow the command: udp-mesh status --socket '/run/x y' --json" in capsys.readouterr().err


@pytest.mark.parametrize("words", [[], ["status"], ["sim"]])
def test_help_and_a_command_is_that_command_s_help(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["help", *words], [*words, "--help"]):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 0
    one, other = capsys.readouterr().out.split("usage: ")[1:]
    assert one == other


@pytest.mark.parametrize("words", sorted(_commands(build_parser())))
def test_every_command_help_shows_a_valid_example(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
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
        ('user = "nobody-here"', "daemon.user: no such user: 'nobody-here'"),
        ('socket_group = "no-such-group"', "daemon.socket_group: no such group"),
    ],
)
def test_a_daemon_startup_failure_reports_the_reason(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, daemon: str, complaint: str
) -> None:
    path = tmp_path / "mesh.toml"
    path.write_text(
        f'unkeyed = true\n[[links]]\ninterface = "none0"\n[daemon]\nsocket = "{tmp_path}/s"\n'
        f'state_directory = "{tmp_path}/state"\n{daemon}\n'
    )
    assert main(["run", str(path)]) == Exit.FAILED
    assert f"udp-mesh: cannot start: {complaint}" in capsys.readouterr().err


def test_an_inaccessible_directory_is_reported_with_a_hint(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "mesh.toml"
    (tmp_path / "file").touch()
    path.write_text(f'unkeyed = true\n[daemon]\nsocket = "{tmp_path}/file/s"\nstate_directory = "{tmp_path}"\n')
    assert main(["run", str(path)]) == Exit.FAILED
    assert f"cannot start: {tmp_path}/file" in capsys.readouterr().err
    assert serve._reason(PermissionError(errno.EACCES, "Permission denied", "/run/udp-mesh")) == (
        "/run/udp-mesh: Permission denied (run as root, or change `socket` and `state_directory` in [daemon])"
    )


def test_events_are_printed_until_the_daemon_ends(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A fake daemon that exits after one event: the command reports it and exits."""
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
