"""The whole kill matrix: every command a node runs during an apply, every step of a flash, every word of meshctl.

`recorded` lists the commands of one undisturbed run; `apply_matrix` and `flash_matrix` strike at them, a batch of
nodes at a time, `kill_matrix` at meshctl, all going back and forth between two states; `table` sums up, and `filled`
puts that into a page.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from meshctl.model import Release
from meshlab.images import firmware_image
from tests.meshctl.proof.kills import Case, strike_meshctl, strike_nodes
from tests.meshctl.proof.rig import Rig

T = TypeVar("T")
# a case, its phase, and the number of its batch (of its word, for kills)
Tell = Callable[[Case, str, int], None]
IsEnough = Callable[[], bool]


def never() -> bool:
    """For a matrix that is gone through to its end."""
    return False


# A command that begins a phase, in the order in which they come; what comes before the first is `observe`.
PHASES = (
    ("lock", "lock."),
    ("stage", ".tgz"),
    ("arm", "armed."),
    ("apply", "start-stop-daemon"),
    ("put", "mv -f /etc/meshctl/change/new"),
    ("reload", "reload_config"),
    ("prove", "ubus call system board"),
    ("confirm", "confirmed."),
)
# A flash ends in a reboot that forgets what was recorded, so its steps are named: phase and words of a command.
FLASH_STEPS = (
    ("observe", "df -k / /tmp"),
    ("lock", "ln /tmp/meshctl/new"),
    ("upload", "dd if=/dev/null of=/tmp/meshctl/.firmware.bin"),
    ("upload", "tail -c"),
    ("upload", "mv -f /tmp/meshctl/.firmware.bin"),
    ("test", "sysupgrade -T"),
    ("test", "ubus call system validate_firmware_image"),
    ("archive", "tar -cf"),
    ("archive", "mv -f /tmp/meshctl/.firmware.tgz"),
    ("start", "start-stop-daemon"),
    ("start", "sysupgrade -n"),
)


def phases_of(commands: Sequence[str]) -> list[str]:
    """The phase of each command: phases come in order, each begins with the first command that holds its mark."""
    phases, left, now = [], list(PHASES), "observe"
    for command in commands:
        if left and left[0][1] in command:
            now = left.pop(0)[0]
        phases.append(now)
    return phases


def recorded(rig: Rig, new: str) -> list[str]:
    """The external commands that the first node runs while it is brought to `new`."""
    node = rig.fleet.node(rig.names[0])
    node.record_steps()
    ended = rig.meshctl("provision", new, "--yes", "--json")
    commands = [command for command in node.steps() if "steps.log" not in command]
    rig.fleet.repair(rig.names[0])
    if ended.code != 0:
        raise AssertionError(f"an undisturbed run failed: {ended.out} {ended.err}")
    return commands


def apply_matrix(rig: Rig, tell: Tell, *, every: int = 1, first: int = 1, is_enough: IsEnough = never) -> int:
    """Power and links cut at every `every`-th command of an apply, from the `first` batch on; the next, or 0."""
    phases = phases_of(recorded(rig, "b"))
    there, other = "b", "a"
    batches = [
        (kind, batch) for kind in ("power-cut", "sever") for batch in _batches(_struck(phases, every), rig.count)
    ]
    for number, (kind, batch) in enumerate(batches[first - 1 :], first):
        if is_enough():
            return number
        steps = {name: str(step) for name, step in zip(rig.names, batch, strict=False)}
        for case in strike_nodes(rig, steps, kind, old=there, new=other):
            tell(case, phases[int(case.step) - 1], number)
        there, other = other, there
    return 0


def kill_matrix(
    rig: Rig,
    tell: Tell,
    *,
    every: int = 1,
    first: int = 1,
    verb: str = "apply",
    is_enough: IsEnough = never,
) -> int:
    """meshctl killed at every `every`-th of its words (node begun, step, progress, outcome), from the `first` on; the
    next word, or 0.

    Over a rig with firmware each run is a flash, and `verb` says so.
    """
    there, other = "a", "b"
    words, is_killed = first, True
    while is_killed:
        if is_enough():
            return words
        cases = strike_meshctl(rig, words, old=there, new=other, verb=verb)
        is_killed = any(case.outcome == "killed" for case in cases)
        for case in cases if is_killed else ():
            tell(case, case.step, words)
        there, other = other, there
        words += every
    return 0


def flash_matrix(rig: Rig, tell: Tell, *, first: int = 1, is_enough: IsEnough = never) -> int:
    """Power and links cut at the steps of a flash, from the `first` batch on; the firmware goes back and forth with the
    configuration. The next batch, or 0."""
    there, other = "a", "b"
    phase_at = {words: phase for phase, words in FLASH_STEPS}
    batches = [(kind, batch) for kind in ("power-cut", "sever") for batch in _batches(tuple(phase_at), rig.count)]
    batches.append(("power-cut", ("flash",)))
    for number, (kind, batch) in enumerate(batches[first - 1 :], first):
        if is_enough():
            return number
        steps = dict(zip(rig.names, batch, strict=False))
        for case in strike_nodes(rig, steps, kind, old=there, new=other, verb="flash"):
            tell(case, phase_at.get(case.step, "writing"), number)
        there, other = other, there
    return 0


# Commands that only read are many and alike: of those every so many is struck.
READING = ("observe", "prove")
READING_EVERY = 6


def _struck(phases: Sequence[str], every: int) -> list[int]:
    """The numbers (from 1) of the commands to strike at."""
    return [
        number
        for number, phase in enumerate(phases, 1)
        if number % (READING_EVERY * every if phase in READING else every) == 0
    ]


def _batches(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    return (items[start : start + size] for start in range(0, len(items), size))


def firmware(directory: Path) -> dict[str, str]:
    """Two images in `directory`, one for each of the inventories a and b, as lines for their hardware profile."""
    directory.mkdir(parents=True, exist_ok=True)
    lines = {}
    for variant, revision in (("a", "r10001-aaaaaaaaaa"), ("b", "r10002-bbbbbbbbbb")):
        image = firmware_image(Release.V23_05, board="compex,wpj344-16m", revision=revision)
        (directory / f"{variant}.bin").write_bytes(image)
        digest = hashlib.sha256(image).hexdigest()
        lines[variant] = f"    firmware: {{image: {variant}.bin, sha256: {digest}, revision: {revision}}}"
    return lines


def table(records: Iterable[Mapping[str, object]]) -> Iterator[str]:
    """A Markdown table of the cases that were struck: operation, fault, step, version of the script, how they ended."""
    rows: dict[tuple[str, str, str, str], list[Mapping[str, object]]] = {}
    for record in records:
        if not record.get("struck", True):
            continue
        key = (str(record["verb"]), str(record["kind"]), str(record["phase"]), str(record["version"]))
        rows.setdefault(key, []).append(record)
    yield "| operation | fault | step | script | cases | old | new | bricked | neither | unreachable | not resumed |"
    yield "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    for (verb, kind, phase, script), cases in rows.items():
        old, new, bricked = (sum(case["state"] == state for case in cases) for state in ("old", "new", "bricked"))
        mixed = len(cases) - old - new - bricked
        away = sum(not case["reachable"] for case in cases)
        left = sum(not case["resumed"] for case in cases)
        counts = " | ".join(str(count) for count in (len(cases), old, new, bricked, mixed, away, left))
        yield f"| {verb} | {kind} | {phase} | {script} | {counts} |"


def filled(page: str, rows: Iterable[str]) -> str:
    """The page with these rows of `table` in place of those of the same operation, fault and step; others stay. The
    sentence that counts the cases follows from all of them."""
    new = {_subject(row): f"{row}\n" for row in rows if not row.startswith(("| operation", "| ---"))}
    lines = page.splitlines(keepends=True)
    head = next(number for number, line in enumerate(lines) if line.startswith("| operation |"))
    end = next(number for number, line in enumerate(lines[head:], head) if not line.startswith("|"))
    kept = [new.pop(_subject(line), line) for line in lines[head + 2 : end]]
    # stable: a step that the page did not have comes after the others of its fault
    all_rows = sorted([*kept, *new.values()], key=lambda row: _ORDER.index(_subject(row)[:2]))
    text = "".join([*lines[: head + 2], *all_rows, *lines[end:]])
    return _COUNTED.sub(lambda _: counted_cases(all_rows), text, count=1)


def counted_cases(rows: Iterable[str]) -> str:
    """How many cases the rows of a table have, and with which scripts they were recorded."""
    by_script: Counter[int] = Counter()
    bad = 0
    for row in rows:
        _, _, _, _, script, cases, *_, neither, away, left, _ = (cell.strip() for cell in row.split("|"))
        by_script[int(script)] += int(cases)
        bad += int(neither) + int(away) + int(left)
    which = ", ".join(f"{cases} with version {script}" for script, cases in sorted(by_script.items(), reverse=True))
    return f"{by_script.total()} cases, {bad} failed: {which} of the dead-man script"


_COUNTED = re.compile(r"\d+ cases, \d+ failed: [^.:]* of the dead-man script")

# operations and faults in the order of the page
_ORDER = [(operation, fault) for operation in ("apply", "flash") for fault in ("power-cut", "sever", "kill meshctl")]


def _subject(row: str) -> tuple[str, str, str]:
    _, operation, fault, step, *_ = (cell.strip() for cell in row.split("|"))
    return operation, fault, step
