"""The whole kill matrix: every external command a node runs during apply and flash, every word meshctl says meanwhile.

`recorded` lists the commands of one undisturbed run; `apply_matrix` and `flash_matrix` strike at each of them, a batch
of nodes at a time, `kill_matrix` at meshctl, going back and forth between two states; `phase_of` says what a command belongs to; `table` sums up.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from meshctl.lab.images import firmware_image
from meshctl.model import Release
from tests.meshctl.proof.kills import Case, strike_meshctl, strike_nodes
from tests.meshctl.proof.rig import Rig

# A command that begins a phase, in the order in which they come; what comes before the first is `observe`.
PHASES = (
    ("lock", "lock."),
    ("stage", ".tgz"),
    ("arm", "armed."),
    ("apply", "start-stop-daemon"),
    ("put", "mv -f /etc/meshctl/change/new"),
    ("reload", "reload_config"),
    ("prove", "cat /proc/uptime"),
    ("confirm", "confirmed."),
)
FLASH_PHASES = (
    ("lock", "lock."),
    ("upload", "firmware.bin"),
    ("test", "sysupgrade -T"),
    ("archive", "firmware.tgz"),
    ("flash", "sysupgrade -n"),
)


def phases_of(commands: Sequence[str], marks: Sequence[tuple[str, str]] = PHASES) -> list[str]:
    """The phase of each command: phases come in order, each begins with the first command that holds its mark."""
    phases, left, now = [], list(marks), "observe"
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
    rig.fleet.mend(rig.names[0])
    if ended.code != 0:
        raise AssertionError(f"an undisturbed run failed: {ended.out} {ended.err}")
    return commands


def apply_matrix(rig: Rig, tell: Callable[[Case, str], None], *, every: int = 1) -> None:
    """Power and links cut at every `every`-th command of an apply."""
    commands = recorded(rig, "b")
    phases = phases_of(commands)
    there, other = "b", "a"
    for kind in ("power-cut", "sever"):
        for batch in _batches(_struck(phases, every), rig.count):
            steps = {name: str(number) for name, number in zip(rig.names, batch, strict=False)}
            for case in strike_nodes(rig, steps, kind, old=there, new=other):
                tell(case, phases[int(case.step) - 1])
            there, other = other, there


def kill_matrix(rig: Rig, tell: Callable[[Case, str], None], *, every: int = 1) -> None:
    """meshctl killed at every `every`-th of its words (node begun, step, progress, outcome)."""
    there, other = "a", "b"
    words, is_killed = 1, True
    while is_killed:
        cases = strike_meshctl(rig, words, old=there, new=other)
        is_killed = any(case.outcome == "killed" for case in cases)
        for case in cases if is_killed else ():
            tell(case, case.step)
        there, other = other, there
        words += every


def flash_matrix(rig: Rig, tell: Callable[[Case, str], None], *, every: int = 1) -> None:
    """Power and links cut at every command of a flash; the firmware goes back and forth with the configuration."""
    commands = recorded(rig, "b")
    phases = phases_of(commands, FLASH_PHASES)
    there, other = "b", "a"
    for kind in ("power-cut", "sever"):
        for batch in _batches(_struck(phases, every), rig.count):
            steps = {name: str(number) for name, number in zip(rig.names, batch, strict=False)}
            for case in strike_nodes(rig, steps, kind, old=there, new=other, verb="flash"):
                tell(case, phases[int(case.step) - 1])
            there, other = other, there
    for case in strike_nodes(rig, {rig.names[0]: "flash"}, "power-cut", old=there, new=other, verb="flash"):
        tell(case, "writing")


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


def _batches(numbers: Sequence[int], size: int) -> Iterator[Sequence[int]]:
    return (numbers[start : start + size] for start in range(0, len(numbers), size))


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
    """A Markdown table: what was struck, where, how often, and how it ended."""
    rows: dict[tuple[str, str, str], list[Mapping[str, object]]] = {}
    for record in records:
        key = (str(record["verb"]), str(record["kind"]), str(record["phase"]))
        rows.setdefault(key, []).append(record)
    yield "| work | struck | during | cases | old | new | bricked | neither | out of reach | not resumed |"
    yield "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    for (verb, kind, phase), cases in rows.items():
        old, new, bricked = (sum(case["state"] == state for case in cases) for state in ("old", "new", "bricked"))
        mixed = len(cases) - old - new - bricked
        away = sum(not case["reachable"] for case in cases)
        left = sum(not case["resumed"] for case in cases)
        yield (f"| {verb} | {kind} | {phase} | {len(cases)} | {old} | {new} | {bricked} | {mixed} | {away} | {left} |")
