"""Actions of the page: nothing happens before the device's name is typed, and then exactly what was shown."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from meshctl.errors import InputError
from meshctl.monitor.actions import CONFIRM_WITHIN_S, Actions, Job
from tests.waiting import until

# Prints its words, and notes those of commands that change something.
PROGRAM = """\
import sys
words = sys.argv[2:]
print("ran", *words)
if "--dry-run" not in words and words[0] != "plan":
    open(sys.argv[1], "a").write(" ".join(words) + "\\n")
sys.exit(3 if "b09" in words else 0)
"""


class Bench:
    def __init__(self, directory: Path) -> None:
        self.log = directory / "changes"
        self.now_s = 100.0
        self.actions = Actions(
            [sys.executable, "-c", PROGRAM, str(self.log)],
            ["--inventory", "fleet.yaml"],
            lambda: frozenset(("b01", "b09", "--yes")),
            directory,
            lambda: self.now_s,
        )

    def prepared(self, action: str, device: str = "b01") -> Job:
        return self.ended(self.actions.prepare(action, device))

    def ended(self, job: Job) -> Job:
        until(lambda: job.exit_code is not None, job.action)
        return job

    @property
    def changes(self) -> list[str]:
        return self.log.read_text().splitlines() if self.log.exists() else []


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.actions.close()


@pytest.mark.parametrize(
    ("action", "shown", "done"),
    [
        ("deployed", "deployed b01 --dry-run", "deployed b01"),
        ("carried", "deployed b01 --back --dry-run", "deployed b01 --back"),
        ("reboot", "Reboots b01.", "run b01 --inventory fleet.yaml -- "),
        ("provision", "plan b01 --out ", "apply "),
    ],
)
def test_an_action_is_shown_confirmed_and_carried_out_once(bench: Bench, action: str, shown: str, done: str) -> None:
    job = bench.prepared(action)
    assert (shown in job.output, job.is_confirmable, bench.changes) == (True, True, [])
    for wrong in ("", "b0", "b01 ", "B01", "yes"):
        with pytest.raises(InputError, match="not confirmed"):
            bench.actions.confirm(job.id, wrong)
    assert bench.changes == []
    bench.ended(bench.actions.confirm(job.id, "b01"))
    (change,) = bench.changes
    assert change.startswith(done)
    with pytest.raises(InputError, match="nothing to confirm"):
        bench.actions.confirm(job.id, "b01")
    assert len(bench.changes) == 1


def test_the_plan_that_was_shown_is_the_one_that_is_applied(bench: Bench) -> None:
    job = bench.prepared("provision")
    planned = job.output.split("--out ")[1].split()[0]
    bench.ended(bench.actions.confirm(job.id, "b01"))
    assert bench.changes == [f"apply {planned} --inventory fleet.yaml"]


def test_a_failed_preparation_cannot_be_confirmed(bench: Bench) -> None:
    job = bench.prepared("provision", "b09")
    assert (job.exit_code, job.is_confirmable) == (3, False)
    with pytest.raises(InputError, match="nothing to confirm"):
        bench.actions.confirm(job.id, "b09")


def test_what_was_shown_too_long_ago_is_not_carried_out(bench: Bench) -> None:
    job = bench.prepared("deployed")
    bench.now_s += CONFIRM_WITHIN_S + 1
    with pytest.raises(InputError, match="too long ago"):
        bench.actions.confirm(job.id, "b01")
    assert bench.changes == []


@pytest.mark.parametrize(("action", "device"), [("format", "b01"), ("reboot", "b02"), ("deployed", "--back"), ("", "")])
def test_unknown_actions_and_devices_are_refused(bench: Bench, action: str, device: str) -> None:
    with pytest.raises(InputError):
        bench.actions.prepare(action, device)
    with pytest.raises(InputError):
        bench.actions.confirm("nothing", "b01")
    assert bench.changes == []
