"""The guide on programs: what it shows runs beside two daemons."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons
from tests.udp_mesh.links.sockets import WAIT_S

GUIDE = (Path(__file__).parents[3] / "docs" / "how-to" / "write-programs.md").read_text(encoding="utf-8")
TOPICS = re.search(r"^```toml\n\[topics\]\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
PROGRAMS = dict(re.findall(r"^```python\n# (\w+)\.py\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL))

pytestmark = pytest.mark.xdist_group("udp_mesh_client")


def patient(text: str) -> str:
    """With the time that a busy machine may take."""
    return re.sub(r"(timeout_s=|deadline_s = )[\d.]+", rf"\g<1>{WAIT_S:g}", text)


def command(name: str) -> list[str]:
    return [sys.executable, "-c", patient(PROGRAMS[name])]


def run(name: str, daemon: RunningDaemon) -> str:
    done = subprocess.run(
        command(name), env=environment(daemon), capture_output=True, text=True, check=False, timeout=WAIT_S
    )
    return done.stdout + done.stderr


def environment(daemon: RunningDaemon) -> dict[str, str]:
    return {"UDP_MESH_SOCKET": str(daemon.socket)}


@contextmanager
def running(name: str, daemon: RunningDaemon, output: Path, topic: str) -> Iterator[None]:
    """The program, once it has subscribed."""
    with output.open("wb") as file:
        process = subprocess.Popen(command(name), env=environment(daemon), stdout=file, stderr=file)
    try:
        with daemon.client() as client:
            poll(lambda: topic in str(client.request("subscriptions")["read_here"]), f"{name} reads {topic}")
        yield
    finally:
        process.kill()
        process.wait()


def test_the_programs_of_the_guide_run_on_two_daemons(tmp_path: Path) -> None:
    assert TOPICS is not None
    with two_daemons(patient(TOPICS[1])) as (alice, bob):
        heard = tmp_path / "heard"
        with running("listen", bob, heard, "report"), running("answer", bob, tmp_path / "answers", "question"):
            assert run("report", alice) == "delivered \n"
            assert run("ask", alice) == "BATTERY?\n"
            assert run("stop", alice) == "bob delivered\n"
            lines = ["alice report found a backpack", "alice estop stop"]
            poll(lambda: heard.read_text().splitlines() == lines, "what bob heard")
            bob.kill()
            poll(lambda: "no daemon: " in heard.read_text(), "the program reports that its daemon is gone")
            bob.start()
            with bob.client() as client:
                poll(lambda: "report" in str(client.request("subscriptions")["read_here"]), "it connects again")
        alice.stop()
        assert "not delivered: cannot connect" in run("report", alice)
