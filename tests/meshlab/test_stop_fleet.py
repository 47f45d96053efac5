"""A supervisor that answers nothing, as behind a machine whose kernel hangs, is ended all the same."""

from __future__ import annotations

import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from meshlab import client, fleet
from tests.waiting import until

_LISTEN = """
import pathlib, socket, sys, time
folder = pathlib.Path(sys.argv[1])
(folder / "supervisor.pid").write_text(str(__import__("os").getpid()))
listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
listening.bind(str(folder / "control.sock"))
listening.listen()
time.sleep(600)
"""


def test_a_supervisor_that_does_not_answer_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("meshlab.fleet.request", partial(client.request, timeout_s=0.2))
    monkeypatch.setattr("meshlab.fleet._DOWN_S", 0.2)
    with subprocess.Popen([sys.executable, "-c", _LISTEN, "."]) as supervisor:
        until(lambda: client.is_running(tmp_path), "the supervisor")
        assert fleet.stop_fleet(tmp_path) == tmp_path.name
        assert supervisor.wait(60) == -signal.SIGKILL
    assert fleet.stop_fleet(tmp_path) == ""
