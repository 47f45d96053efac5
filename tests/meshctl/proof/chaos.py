"""A random schedule of faults over a fleet, from a seed, and beside it a model of what each node may run then.

`rounds_of` makes the schedule, pure. `play` runs one round: one or two operators provision the same inventory while
nodes lose power, links or flash, and operators are killed. `Model` says from the outcomes which state each node may
have; `at_rest` waits until no node has a change under way, without any help from an operator.
"""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from meshctl.device.parse.deadman import parse_status
from tests.meshctl.proof.rig import Ended, Rig

# What may strike a node at any moment of a round.
FAULTS = ("power-cut", "power-cut-torn", "sever", "full-flash", "full-memory", "slow")
UNDER_WAY = ("armed", "waiting", "applied", "orphaned", "restoring")
# After an operator is killed: its lock, the grace of the switch's own timers, a reload.
REST_SLACK_S = 120.0
# Of every result, whether the node runs the old state, the new one, or either.
OLD, NEW = frozenset({"old"}), frozenset({"new"})
MEANING = {
    "done": NEW,
    "unchanged": NEW,
    "rolled back": OLD,
    "refused": OLD,
    "failed": OLD,
    "pending": OLD,
    "unreachable": OLD | NEW,
    "uncertain": OLD | NEW,
}


@dataclass(frozen=True, slots=True)
class Strike:
    """A fault at a node, some seconds after the round began."""

    at_s: float
    node: str
    fault: str


@dataclass(frozen=True, slots=True)
class Round:
    """`kills`: per operator, after which of its events it is killed; None: never."""

    strikes: tuple[Strike, ...]
    kills: tuple[int | None, ...]


def rounds_of(seed: int, names: Sequence[str], count: int) -> tuple[Round, ...]:
    """The schedule of a seed."""
    chance = random.Random(seed)
    rounds = []
    for _ in range(count):
        struck = chance.sample(list(names), chance.randint(1, max(1, len(names) // 2)))
        strikes = tuple(Strike(chance.uniform(0.0, 20.0), name, chance.choice(FAULTS)) for name in struck)
        operators = chance.choice((1, 1, 2))
        kills = tuple(chance.choice((None, chance.randint(1, 30))) for _ in range(operators))
        rounds.append(Round(strikes, kills))
    return tuple(rounds)


@dataclass(slots=True)
class Model:
    """Which of the inventories `a` and `b` each node may run."""

    may_run: dict[str, frozenset[str]] = field(default_factory=dict)

    def update(self, target: str, runs: Iterable[Ended | None]) -> None:
        """Runs of one round to `target`; None is one that was killed, of which nothing is known."""
        results = [None if run is None else run.results for run in runs]
        for name, before in self.may_run.items():
            meanings = [OLD | NEW if of is None else MEANING[of.get(name, "uncertain")] for of in results]
            # once a node has been brought to the new state, no run takes it back
            may_be_old = not any(meaning == NEW for meaning in meanings)
            may_be_new = any("new" in meaning for meaning in meanings)
            self.may_run[name] = (before if may_be_old else frozenset()) | (
                frozenset({target}) if may_be_new else frozenset()
            )


def play(rig: Rig, target: str, round_: Round) -> list[Ended | None]:
    """One round; the runs of its operators."""
    found: list[Ended | None] = [None] * len(round_.kills)

    def operate(index: int, kill_after: int | None) -> None:
        lines: list[str] = []
        with rig.start("provision", target, "--yes", "--json") as process:
            assert process.stdout is not None
            for line in process.stdout:
                lines.append(line)
                if len(lines) == kill_after:
                    process.send_signal(signal.SIGKILL)
            error = process.stderr.read() if process.stderr is not None else ""
            process.wait()
        if process.returncode >= 0:
            found[index] = Ended(process.returncode, "".join(lines), error)

    operators = [threading.Thread(target=operate, args=item) for item in enumerate(round_.kills)]
    timers = [threading.Timer(s.at_s, rig.fleet.inject_fault, (s.node, s.fault)) for s in round_.strikes]
    for thread in (*operators, *timers):
        thread.start()
    for thread in (*operators, *timers):
        thread.join()
    rig.fleet.repair()
    rig.wait_all_up()
    return found


def at_rest(rig: Rig, names: Iterable[str]) -> dict[str, str]:
    """Node -> the state of its switch once no change is under way on any; those still under way after the longest that
    lock, window and timers may take."""
    limit_s = time.monotonic() + rig.window_s * 2 + REST_SLACK_S
    while True:
        states = {}
        for name in names:
            status = parse_status(rig.fleet.node(name).exec("/usr/sbin/meshctl-deadman status").stdout)
            states[name] = "unreadable" if status is None else status.state
        if not set(states.values()) & set(UNDER_WAY) or time.monotonic() > limit_s:
            return states
        time.sleep(1.0)


def leftovers(rig: Rig, names: Iterable[str]) -> dict[str, str]:
    """Node -> the uploads that are left in its memory."""
    found = {}
    for name in names:
        listed = rig.fleet.node(name).exec("ls -A /tmp/meshctl").stdout.split()
        left = [file for file in listed if file.endswith((".tgz", ".part"))]
        if left:
            found[name] = " ".join(left)
    return found
