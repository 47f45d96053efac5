"""The whole kill matrix: every command a node runs during an apply, every step of a flash, every word of meshctl.

`recorded` lists the commands of one undisturbed run; `apply_matrix` and `flash_matrix` strike at them, a batch of
nodes at a time, `kill_matrix` at meshctl, all going back and forth between two states; `table` sums up.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from meshctl.lab.images import firmware_image
from meshctl.model import Release
from tests.meshctl.proof.kills import Case, strike_meshctl, strike_nodes
from tests.meshctl.proof.rig import Rig

T = TypeVar("T")

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
# A flash ends in a reboot that forgets what was recorded, so its steps are named: phase and words of a command.
FLASH_STEPS = (
    ("observe", "cat /etc/board.json"),
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


def kill_matrix(
    rig: Rig, tell: Callable[[Case, str], None], *, every: int = 1, first: int = 1, verb: str = "apply"
) -> None:
    """meshctl killed at every `every`-th of its words (node begun, step, progress, outcome), from the `first` on.

    Over a rig with firmware each run is a flash, and `verb` says so.
    """
    there, other = "a", "b"
    words, is_killed = first, True
    while is_killed:
        cases = strike_meshctl(rig, words, old=there, new=other, verb=verb)
        is_killed = any(case.outcome == "killed" for case in cases)
        for case in cases if is_killed else ():
            tell(case, case.step)
        there, other = other, there
        words += every


def flash_matrix(rig: Rig, tell: Callable[[Case, str], None]) -> None:
    """Power and links cut at the steps of a flash; the firmware goes back and forth with the configuration."""
    there, other = "a", "b"
    phase_at = {words: phase for phase, words in FLASH_STEPS}
    for kind in ("power-cut", "sever"):
        for batch in _batches(tuple(phase_at), rig.count):
            steps = dict(zip(rig.names, batch, strict=False))
            for case in strike_nodes(rig, steps, kind, old=there, new=other, verb="flash"):
                tell(case, phase_at[case.step])
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
