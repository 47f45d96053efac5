"""The exit code of a run."""

from __future__ import annotations

import pytest

from meshctl.cli.context import exit_for
from meshctl.errors import ExitCode
from meshctl.fleet import Interrupt, Outcome, Result


@pytest.mark.parametrize(
    ("results", "code"),
    [
        ((), ExitCode.OK),
        ((Result.DONE, Result.UNCHANGED), ExitCode.OK),
        ((Result.DONE, Result.UNREACHABLE), ExitCode.UNREACHABLE),
        ((Result.REFUSED,), ExitCode.FINDINGS),
        ((Result.FAILED, Result.UNREACHABLE), ExitCode.FINDINGS),
    ],
)
def test_any_failure_other_than_unreachable_nodes_exits_with_findings(
    results: tuple[Result, ...], code: ExitCode
) -> None:
    assert exit_for([Outcome("b03", result) for result in results], Interrupt()) is code


def test_an_interrupted_run_has_its_own_exit_code_whatever_its_outcomes() -> None:
    interrupt = Interrupt()
    interrupt.request()
    assert exit_for([Outcome("b03", Result.FAILED)], interrupt) is ExitCode.INTERRUPTED
