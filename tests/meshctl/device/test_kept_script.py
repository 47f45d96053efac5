"""Scripts that a node's shell keeps, with a real dropbear and busybox ash."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import paramiko
import pytest

from meshctl.device.errors import ChannelClosed, OutputTooLarge, Timeout
from meshctl.device.kept_script import KeptScript
from meshctl.device.observe import observe_again
from meshctl.device.ssh import SshConnection
from meshctl.device.ssh_channel import MAX_OUTPUT_BYTES
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import Server, eventually, log_in

SAY = 'printf "%s|" "$@"'


def kept_shells(node: Sandbox) -> list[int]:
    """The shells that wait for their next line: a short script is in their command line, a long one was read."""
    waiting = (b"while read -r mark words", b"while IFS= read -r l")
    return [process for process in node.processes() if any(loop in _command_line(process) for loop in waiting)]


def _command_line(process: int) -> bytes:
    """Empty when the process has ended."""
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""


def test_each_run_gets_its_own_arguments_and_gives_its_own_status(connection: SshConnection) -> None:
    words = ("a b", "it's", "$HOME `id` \\", "", "*")
    assert connection.run_kept(SAY, words).stdout == "".join(f"{word}|" for word in words)
    assert connection.run_kept(SAY, ()).stdout == "|"
    assert [connection.run_kept("exit $1", [str(n)]).exit_status for n in (0, 7, 255)] == [0, 7, 255]


@pytest.mark.parametrize("length", [10, 9_000, 100_000])
def test_a_script_of_any_length_is_kept(connection: SshConnection, length: int) -> None:
    script = f"# {'long ' * (length // 5)}\n{SAY}"
    assert [connection.run_kept(script, [str(n)]).stdout for n in range(3)] == ["0|", "1|", "2|"]


def test_the_script_is_sent_once(server: Server, node: Sandbox, tmp_path: Path) -> None:
    script = f"# {'long ' * 20_000}\n{SAY}"
    with log_in(server, node, tmp_path) as connection:
        connection.run_kept(script, ["0"])
        shells = kept_shells(node)
        assert len(shells) == 1
        for n in range(20):
            connection.run_kept(script, [str(n)])
        assert kept_shells(node) == shells
        other = connection.run_kept("echo $$", ()).stdout
        assert connection.run_kept("echo $$", ()).stdout == other
    eventually(lambda: not kept_shells(node))


def test_any_bytes_are_output_and_none_are_input(connection: SshConnection) -> None:
    noise = "head -c 300000 /dev/urandom | tee /tmp/noise; cat"
    for _ in range(3):
        done = connection.run_kept(noise, ())
        assert done.stdout_bytes == connection.run("cat /tmp/noise").stdout_bytes


def test_a_run_leaves_nothing_behind_for_the_next(connection: SshConnection) -> None:
    script = 'echo "${left-nothing} $PWD"; left=something; cd /tmp; set -f; exit 3'
    assert [connection.run_kept(script, ()).stdout for _ in range(2)] == [f"nothing {_home(connection)}\n"] * 2


def _home(connection: SshConnection) -> str:
    return connection.run("pwd").stdout.strip()


def test_what_a_script_writes_to_its_standard_error_does_not_fill_the_channel(connection: SshConnection) -> None:
    for _ in range(3):
        assert connection.run_kept("head -c 3000000 /dev/zero >&2; echo done", ()).stdout == "done\n"


def test_a_shell_that_was_killed_between_two_runs_is_started_again(connection: SshConnection, node: Sandbox) -> None:
    assert connection.run_kept(SAY, ["1"]).stdout == "1|"
    (shell,) = kept_shells(node)
    os.kill(shell, signal.SIGKILL)
    eventually(lambda: not kept_shells(node))
    # what the server says of it has arrived with the answer to a later command
    connection.run("true")
    assert connection.run_kept(SAY, ["2"]).stdout == "2|"


def test_a_shell_that_is_killed_during_a_run_is_an_error_and_the_connection_stays(connection: SshConnection) -> None:
    with pytest.raises(ChannelClosed):
        connection.run_kept("kill -9 $$", ())
    assert connection.run("echo here").stdout == "here\n"


def test_a_run_that_never_ends_times_out(connection: SshConnection) -> None:
    assert connection.run_kept("sleep $1", ["0"]).exit_status == 0
    with pytest.raises(Timeout):
        connection.run_kept("sleep $1", ["100000"], timeout_s=0.5)
    assert not connection.is_open


def test_too_much_output_is_an_error_and_the_next_run_answers(connection: SshConnection) -> None:
    script = "head -c $1 /dev/zero"
    with pytest.raises(OutputTooLarge):
        connection.run_kept(script, [str(MAX_OUTPUT_BYTES + 1)])
    assert len(connection.run_kept(script, ["1000"]).stdout_bytes) == 1000


def test_too_much_output_is_read_to_its_end() -> None:
    """dropbear 2022.83 may end the connection when a channel is closed that still has output."""
    left = [b"x" * (1 << 20)] * (3 * MAX_OUTPUT_BYTES >> 20)

    def send(line: bytes) -> None:
        left.extend((line.split()[0], b" 0\n"))

    channel = SimpleNamespace(sendall=send, recv=lambda _: left.pop(0))
    with pytest.raises(OutputTooLarge):
        KeptScript(cast(paramiko.Channel, channel), "b03").run(["1000"])
    assert left == []


def test_an_argument_with_a_line_break_is_refused(connection: SshConnection) -> None:
    with pytest.raises(ValueError, match="line break"):
        connection.run_kept(SAY, ["a\nb"])


def test_a_node_is_observed_again_and_again(connection: SshConnection, node: Sandbox) -> None:
    node.put("/etc/config/system", "config system\n\toption hostname 'one'\n")
    first = observe_again(connection, extra_paths=["/etc/passwd"]).interpret()
    shells = kept_shells(node)
    node.put("/etc/config/system", "config system\n\toption hostname 'two'\n")
    second = observe_again(connection).interpret()
    assert kept_shells(node) == shells
    assert [dict(seen.uci or {})["system"].split("'")[1] for seen in (first, second)] == ["one", "two"]
    assert ["/etc/passwd" in seen.files for seen in (first, second)] == [True, False]
    assert first.notes == second.notes
