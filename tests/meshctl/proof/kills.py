"""The kill matrix: strike at a chosen step, then see that nothing is stranded and a resume finishes the job.

`strike_nodes` cuts power or links of each node at its own step during one run; `strike_meshctl` kills meshctl itself
when it has said so many words. Both return one `Case` per node.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from typing import Any

from meshlab.state import Power
from tests.meshctl.proof.rig import Ended, Rig

# After its window a node puts its files back and reloads.
SLACK_S = 5.0
# Verdicts of nodes that meshctl sees, and how long it may take a flashed one to boot on a busy machine.
SEEN = ("same", "change")
REST_S = 60.0


@dataclass(frozen=True, slots=True)
class Case:
    """One node struck once. `outcome` is what the struck run said, `state` what was on the node's flash afterwards,
    `reachable` whether meshctl could see it then, `resumed` whether a resume brought it to the new state. `struck` is
    False if the run ended before the step: then the case proves nothing."""

    verb: str
    kind: str
    step: str
    node: str
    outcome: str
    state: str
    reachable: bool
    resumed: bool
    struck: bool = True

    @property
    def holds(self) -> bool:
        # a board without a second slot does not survive a power cut while its flash is written: nothing could
        # save it, so it holds once that was reported and the recovery recipe brought it back
        if self.state == "bricked":
            return self.outcome == "uncertain" and self.resumed
        return self.state in ("old", "new") and self.reachable and self.resumed

    def object(self) -> dict[str, Any]:
        return {**asdict(self), "holds": self.holds}


def strike_nodes(
    rig: Rig, steps: Mapping[str, str], kind: str, *, old: str, new: str, verb: str = "apply"
) -> list[Case]:
    """`steps`: node -> the n-th external command, or words of one. `kind` is `power-cut` or `sever`."""
    for name, step in steps.items():
        rig.fleet.inject_fault(name, f"{kind}@{step}")
    with rig.start("provision", new, "--yes", "--json") as process, ThreadPoolExecutor(1) as reader:
        talk = reader.submit(process.communicate)
        _repair_when_undone(rig, set(steps), talk)
        out, err = talk.result()
    run = Ended(process.returncode, out, err)
    dead = [name for name in steps if rig.fleet.node(name).power is Power.DEAD]
    missed = {name for name in steps if rig.fleet.node(name).awaits_fault()}
    for name in steps:
        rig.fleet.repair(name)
    if dead:
        # what the recovery recipe gives back: a factory device on the bench
        rig.wait_all_up()
        rig.meshctl("bootstrap", new, *dead, "--replace-key", "--yes", "--json")
    struck = {name: (kind, step) for name, step in steps.items()}
    return [
        replace(case, state="bricked" if case.node in dead else case.state, struck=case.node not in missed)
        for case in _afterwards(rig, struck, run, old=old, new=new, verb=verb)
    ]


def _repair_when_undone(rig: Rig, names: set[str], talk: Future[tuple[str, str]]) -> None:
    """Give severed nodes their links back once their windows have run out, so that meshctl sees what became of them."""
    severed: dict[str, float] = {}
    while not talk.done():
        for node in rig.fleet.status()["nodes"]:
            name = node["name"]
            if name in names and not node["plugged"]:
                began = severed.setdefault(name, time.monotonic())
                if time.monotonic() - began > rig.window_s + SLACK_S:
                    rig.fleet.repair(name)
                    names.discard(name)
        wait([talk], timeout=0.5)


def strike_meshctl(rig: Rig, words: int, *, old: str, new: str, verb: str = "apply") -> list[Case]:
    """Kill meshctl (SIGKILL) once it has printed `words` events; with fewer events in all it ended by itself."""
    said: list[str] = []
    with rig.start("provision", new, "--yes", "--json") as process:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            if len(said) >= words:
                process.send_signal(signal.SIGKILL)
                break
        rest, err = process.communicate()
    run = Ended(process.returncode, "".join(said) + rest, err)
    struck = {name: ("kill meshctl", _last_word(run, name)) for name in rig.names}
    return _afterwards(rig, struck, run, old=old, new=new, verb=verb)


def _last_word(run: Ended, name: str) -> str:
    events = [event for event in run.events if event.get("node") == name and event["event"] != "note"]
    return str(events[-1].get("text") or events[-1]["event"]) if events else "before it"


def _verdicts(rig: Rig, struck: Mapping[str, tuple[str, str]], new: str) -> dict[str, str]:
    """What meshctl sees of the nodes once they have settled without help.

    A node under its dead-man's switch does while meshctl looks (it clears what a dead meshctl left); one that has
    just begun to be flashed is up for another moment, then gone for a while.
    """
    deadline = time.monotonic() + REST_S
    while True:
        verdicts = rig.meshctl("provision", new, "--check", "--json").verdicts
        if all(verdicts.get(name) in SEEN for name in struck) or time.monotonic() > deadline:
            return verdicts


def _afterwards(
    rig: Rig, struck: Mapping[str, tuple[str, str]], run: Ended, *, old: str, new: str, verb: str
) -> list[Case]:
    if run.code != -signal.SIGKILL and not run.results:
        raise AssertionError(f"the run ended with {run.code} before it began: {run.err}")
    rig.wait_all_up()
    verdicts = _verdicts(rig, struck, new)
    states = {name: rig.state_of(name, old, new) for name in struck}
    resumed = rig.meshctl("resume", new, "--yes", "--json")
    if resumed.code != 0 and not resumed.results:
        raise AssertionError(f"resume could not run: {resumed.err}")
    return [
        Case(
            verb,
            kind,
            step,
            name,
            run.results.get(name, "killed"),
            states[name],
            verdicts.get(name) in SEEN,
            rig.state_of(name, old, new) == "new",
        )
        for name, (kind, step) in struck.items()
    ]
