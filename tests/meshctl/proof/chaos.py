"""A random schedule of faults over a fleet, from a seed, and beside it a model of what each node may run then.

`rounds_of` makes the schedule, pure. `play` runs one round: operators provision (which changes the cell of the whole
mesh where the target has another one), resume, back up and restore, while nodes lose power, links or flash, and
operators are killed. `Model` says from the outcomes which state each node may have; `at_rest` waits until no node has
a change under way, without any help from an operator.
"""

from __future__ import annotations

import math
import random
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from meshctl.apply.backup import read_backup
from meshctl.apply.mesh_commit import ARM_S
from meshctl.device.parse.deadman import parse_status
from tests.meshctl.proof.rig import QUORUM, SPLIT_CHANNELS, VARIANTS, Ended, Rig

# What may strike a node at any moment of a round.
FAULTS = ("power-cut", "power-cut-torn", "sever", "full-flash", "full-memory", "slow")
UNDER_WAY = ("armed", "waiting", "applied", "orphaned", "restoring")
# After an operator is killed: its lock, the grace of the switch's own timers, a reload. In a change of the whole mesh
# the lock lasts longer by ARM_S for each batch of nodes.
REST_SLACK_S = 120.0
# A timer looks every few seconds whether its change has ended.
TIMER_TURN_S = 20.0
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
# What may stay in /tmp/meshctl: the lock's number, the switch's own FIFO, and of its last reload the script's output
# and the numbers of its processes.
KEPT = re.compile(r"lock\.\d+|pause|reload\.(log|pid|waits|members)|reloaded|extra\.log")
BACKUP_NAME = re.compile(r"(.+)-\d{8}T\d{6}Z\.tgz")


@dataclass(frozen=True, slots=True)
class Strike:
    """A fault at a node, some seconds after the round began."""

    at_s: float
    node: str
    fault: str


@dataclass(frozen=True, slots=True)
class Operator:
    """`verb` is provision, resume, backup or restore (of `node`); `kill_after`: which of its events it is killed
    after; None: never."""

    verb: str
    kill_after: int | None = None
    node: str = ""

    @property
    def is_of_the_fleet(self) -> bool:
        return self.verb in ("provision", "resume")


@dataclass(frozen=True, slots=True)
class Round:
    """`target` is the inventory that all of its operators use."""

    target: str
    strikes: tuple[Strike, ...]
    operators: tuple[Operator, ...]


def rounds_of(seed: int, names: Sequence[str], count: int) -> tuple[Round, ...]:
    """The schedule of a seed. Each round has another target than the one before; the first changes from `a`."""
    chance = random.Random(seed)
    rounds = []
    target = "a"
    for _ in range(count):
        target = chance.choice([variant for variant in VARIANTS if variant != target])
        struck = chance.sample(list(names), chance.randint(0, max(1, len(names) // 2)))
        strikes = tuple(Strike(chance.uniform(0.0, 20.0), name, chance.choice(FAULTS)) for name in struck)
        second = chance.choice(("", "", "provision", "resume", "backup", "restore"))
        verbs = ("provision", second) if second else ("provision",)
        operators = tuple(
            Operator(
                verb, chance.choice((None, chance.randint(1, 30))), chance.choice(names) if verb == "restore" else ""
            )
            for verb in verbs
        )
        rounds.append(Round(target, strikes, operators))
    return tuple(rounds)


@dataclass(frozen=True, slots=True)
class Ran:
    """What an operator did: `nodes` are those that it might change, `target` the state that it would bring them to;
    `ended` is None for one that was killed, of which nothing else is known."""

    operator: Operator
    target: str
    ended: Ended | None

    def meaning(self, name: str) -> frozenset[str]:
        """Whether the node runs what it ran before, what this operator wanted, or either."""
        if self.operator.verb == "backup" or (self.operator.node and self.operator.node != name):
            return OLD
        # a run that ended without an outcome of the node has not begun with it
        return OLD | NEW if self.ended is None else MEANING[self.ended.results.get(name, "pending")]


@dataclass(slots=True)
class Model:
    """Which of the inventories each node may run."""

    may_run: dict[str, frozenset[str]] = field(default_factory=dict)

    def update(self, ran: Iterable[Ran]) -> None:
        """Take over what the operators of one round did."""
        ran = list(ran)
        for name, before in self.may_run.items():
            meanings = [(each.target, each.meaning(name)) for each in ran]
            brought = frozenset(target for target, meaning in meanings if "new" in meaning)
            # once one operator has brought a node to its state, only another one's takes it elsewhere
            may_be_old = not any(meaning == NEW for _, meaning in meanings)
            self.may_run[name] = (before if may_be_old else frozenset()) | brought


def split_mesh(before: Mapping[str, str], target: str, ended: Ended) -> str:
    """What is wrong with a change of the cell that ended with these outcomes; empty: nothing.

    All or nothing: a quorum with the base is in the new cell, or no node is.
    """
    moving = [name for name, ran in before.items() if _channel(ran) != _channel(target)]
    results = ended.results
    done = [name for name in moving if results.get(name) == "done"]
    if not done:
        return ""
    needed = math.ceil(QUORUM * len([name for name in moving if name in results]))
    if len(done) < needed or ("base" in moving and "base" not in done):
        return f"{len(done)} of {len(moving)} nodes changed their cell, {needed} with the base were required: {results}"
    return ""


def _channel(variant: str) -> int:
    return SPLIT_CHANNELS[VARIANTS.index(variant)]


def play(rig: Rig, round_: Round, backups: Path) -> list[Ran]:
    """One round; what its operators did. Backups go to `backups`, and are restored from there."""
    found: list[Ran] = []

    def operate(operator: Operator) -> None:
        words, target = _command(rig, operator, round_.target, backups)
        if words:
            ended = run_until(operator.kill_after, rig.start(operator.verb, round_.target, *words, "--json"))
            found.append(Ran(operator, target, ended))

    strike_during(rig, round_.strikes, [partial(operate, operator) for operator in round_.operators])
    return found


def run_until(kill_after: int | None, process: subprocess.Popen[str]) -> Ended | None:
    """A run of meshctl; None if it was killed, as soon as it had printed so many lines."""
    lines: list[str] = []
    with process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if len(lines) == kill_after:
                process.send_signal(signal.SIGKILL)
        error = process.stderr.read() if process.stderr is not None else ""
        process.wait()
    return Ended(process.returncode, "".join(lines), error) if process.returncode >= 0 else None


def strike_during(
    rig: Rig, strikes: Sequence[Strike], acts: Sequence[Callable[[], object]], off: Sequence[str] = ()
) -> None:
    """All acts at once while nodes are struck; then all nodes are repaired, except those that stay `off`."""
    threads = [threading.Thread(target=act) for act in acts]
    timers = [threading.Timer(s.at_s, rig.fleet.inject_fault, (s.node, s.fault)) for s in strikes]
    for thread in (*threads, *timers):
        thread.start()
    for thread in (*threads, *timers):
        thread.join()
    for name in ("base", *rig.names):
        if name not in off:
            rig.fleet.repair(name)
    rig.wait_all_up(off)


def _command(rig: Rig, operator: Operator, target: str, backups: Path) -> tuple[tuple[str, ...], str]:
    """The words of an operator's command, and the state that it would bring nodes to; nothing to restore: no words."""
    match operator.verb:
        case "backup":
            return ("--out", str(backups)), target
        case "restore":
            file = next(iter(sorted(backups.glob(f"{operator.node}-*.tgz"), reverse=True)), None)
            return (() if file is None else (operator.node, str(file), "--yes")), (
                "" if file is None else state_in(rig, file)
            )
        case _:
            return ("--yes",), target


def state_in(rig: Rig, file: Path) -> str:
    """Which inventory a backup is wholly of, or `a mixture`. Raises InputError for a file that is not whole."""
    saved = read_backup(file.read_bytes(), str(file))
    name = BACKUP_NAME.fullmatch(file.name)
    assert name is not None, file
    assert saved.node == name[1], f"{file} is of {saved.node}"
    return rig.variant_of(saved.node, {path.lstrip("/"): new.content for path, new in saved.files.items()})


def at_rest(rig: Rig, names: Iterable[str]) -> dict[str, str]:
    """Node -> the state of its switch once no change or rollback is under way on any; those still under way after the
    longest that lock, window and timers may take."""
    nodes = list(names)
    batches = math.ceil(len(nodes) / (rig.parallel or 1))
    limit_s = time.monotonic() + rig.window_s * 2 + REST_SLACK_S + batches * ARM_S
    while True:
        states = {name: _state(rig, name) for name in nodes}
        if not set(states.values()) & set(UNDER_WAY) or time.monotonic() > limit_s:
            return states
        time.sleep(1.0)


def _state(rig: Rig, name: str) -> str:
    node = rig.fleet.node(name)
    status = parse_status(node.exec("/usr/sbin/meshctl-deadman status").stdout)
    if status is None:
        return "unreadable"
    # the change has ended by then, and its services still reload
    is_restoring = node.exec("[ ! -e /tmp/meshctl/restoring ] || echo yes").stdout != ""
    return "restoring" if is_restoring else status.state


def leftovers(rig: Rig, names: Iterable[str]) -> dict[str, str]:
    """Node -> what is left of changes once all have ended: files in its memory, a lock, a timer's process."""
    return _remaining(lambda name: _left_on(rig, name), names)


def uploads(rig: Rig, names: Iterable[str]) -> dict[str, str]:
    """Node -> the archives of changes in its memory. A node deletes what a killed operator has sent half."""

    def archives(name: str) -> str:
        return " ".join(rig.fleet.node(name).exec("ls -A /tmp/meshctl | grep 'tgz'").stdout.split())

    return _remaining(archives, names)


def _remaining(left_on: Callable[[str], str], names: Iterable[str]) -> dict[str, str]:
    """Node -> what is left on it, once nothing is, or after the time in which timers end."""
    limit_s = time.monotonic() + TIMER_TURN_S
    while True:
        found = {name: left for name in names if (left := left_on(name))}
        if not found or time.monotonic() > limit_s:
            return found
        time.sleep(1.0)


# all files but those of a process that ends by itself, as the watch for stale station entries does
_NOT_IN_USE = """
cd /tmp/meshctl && for file in $(ls -A); do
    case $file in *.pid) [ ! -e "/proc/$(cat "$file")" ] || continue ;; esac
    echo "$file"
done"""


def _left_on(rig: Rig, name: str) -> str:
    node = rig.fleet.node(name)
    left = [file for file in node.exec(_NOT_IN_USE).stdout.split() if not KEPT.fullmatch(file)]
    status = parse_status(node.exec("/usr/sbin/meshctl-deadman status").stdout)
    if status is None or status.state != "idle" or status.lock_owner:
        left.append(str(status))
    # not the grep itself
    timers = node.exec("grep -l '[m]eshctl-deadman' /proc/[0-9]*/cmdline | while read -r f; do tr '\\0' ' ' <$f; done")
    return " ".join([*left, *timers.stdout.split()])
