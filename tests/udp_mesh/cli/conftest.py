"""Two real daemons, and the command line on one of them."""

from collections.abc import Callable, Iterator

import pytest

from tests.udp_mesh.daemon.processes import RunningDaemon, two_daemons
from udp_mesh.cli.main import main

Pair = tuple[RunningDaemon, RunningDaemon]
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with two_daemons() as daemons:
        yield daemons


@pytest.fixture
def run(pair: Pair, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command on alice; returns its exit code, output and errors."""

    def run_command(*words: str) -> tuple[int, str, str]:
        code = main([*words, "--socket", str(pair[0].socket)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run_command
