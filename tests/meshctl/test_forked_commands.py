"""A command that is forked is a process as if it were started: streams, environment, exit status, signals."""

from __future__ import annotations

import os
import select
import signal
from pathlib import Path
from tempfile import TemporaryFile

import pytest

from meshctl import __version__
from tests.meshctl import forked_commands
from tests.meshctl.proof.rig import run


def test_output_and_exit_status_are_those_of_the_command() -> None:
    said = run(["--version"], {})
    assert (said.code, said.out, said.err) == (0, f"meshctl {__version__}\n", "")
    refused = run(["lint", "--nonsense"], {})
    assert (refused.code, refused.out) == (2, "")
    assert "No such option" in refused.err


def test_environment_and_directory_are_those_of_the_caller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert f"{tmp_path}/a.yaml" in run(["lint"], {"MESHCTL_INVENTORY": f"{tmp_path}/a.yaml"}).out
    assert f"expected in {tmp_path}:" in run(["lint", "b.yaml"], {}).out


def test_a_command_has_a_session_of_its_own_and_ends_by_the_signal_it_gets() -> None:
    reading, writing = os.pipe()
    with TemporaryFile() as err, open(reading, "rb"):
        with open(writing, "wb") as out:
            # more than a pipe holds, which is not read
            process = forked_commands.start(["schema"], {}, out, err)
        assert select.select([reading], [], [], forked_commands.LIMIT_S)[0]
        assert (process.poll(), os.getsid(process.pid)) == (None, process.pid)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert process.poll() == -signal.SIGKILL
        process.kill()
