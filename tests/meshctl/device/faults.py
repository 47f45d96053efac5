"""Stopping the dead-man's switch anywhere: each external command of the script is counted, and can be the last.

`Faults.run` runs one verb with every command that changes a file wrapped: it can kill the process group before the n-th
command (SIGKILL, as the kernel does it), or take a picture of the flash before each. From the pictures, `after_cut`
makes what a power cut could leave: the files as they were after any number of commands, and the same with the content
that no `sync` had yet secured torn away.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.meshctl.device.sandbox import Sandbox

# Every command of deadman.sh that changes a file. What only reads need not be counted: to stop before it or before the
# next of these is the same.
COMMANDS = ("mv", "rm", "cp", "cat", "mkdir", "rmdir", "chmod", "ln", "tar")

WRAP = """\
tick() {
	read -r tick_n </harness/n
	tick_n=$((tick_n + 1))
	echo $tick_n >/harness/n
	[ -z "$PICTURES" ] || command cp -a /etc "/harness/pictures/$tick_n"
	echo "$tick_n $*" >>/harness/commands
	[ "$tick_n" != "$KILL_AT" ] || kill -9 0
}
read() {
	[ -z "$STOP_AT_SLEEP" ] || [ "$2" != -t ] || kill -9 0
	command read "$@"
}
sleep() {
	[ -z "$STOP_AT_SLEEP" ] || kill -9 0
	command sleep "$@"
}
""" + "".join(f'{name}() {{ tick {name} "$@"; command {name} "$@"; }}\n' for name in COMMANDS)

# The script calls sync by its path, so it is counted there, for the verb under control and not for processes that it
# starts beside itself.
SYNC = """\
#!/bin/sh
read -r front </harness/front
[ -z "$COUNTED" ] || [ "$PPID" != "$front" ] || { . /harness/wrap.sh; tick sync; }
"""


@dataclass(frozen=True, slots=True)
class Run:
    """One verb's run: its answer, whether it was killed, and the commands it got to, in order."""

    answer: str
    killed: bool
    commands: tuple[str, ...]


class Faults:
    """Runs the verbs of one node's switch under control."""

    def __init__(self, node: Sandbox) -> None:
        self.node = node
        node.put("/harness/wrap.sh", WRAP)
        node.put("/bin/sync", SYNC, 0o755)

    def run(
        self,
        *words: str,
        kill_at: int | None = None,
        pictures: bool = False,
        stop_at_sleep: bool = False,
        stdin: str = "",
    ) -> Run:
        """`meshctl-deadman WORDS`; `kill_at` counts from 1, `stop_at_sleep` kills it when it begins to wait, `stdin` is
        a file on the node."""
        self.node.put("/harness/n", "0\n")
        self.node.put("/harness/commands", "")
        shutil.rmtree(self.pictures, ignore_errors=True)
        self.pictures.mkdir()
        done = self.node.run(
            "/bin/sh",
            "-c",
            '. /harness/wrap.sh; echo $$ >/harness/front; [ -z "$STDIN" ] || exec <"$STDIN"; '
            ". /usr/sbin/meshctl-deadman",
            "meshctl-deadman",
            *words,
            COUNTED="yes",
            KILL_AT="" if kill_at is None else str(kill_at),
            PICTURES="yes" if pictures else "",
            STOP_AT_SLEEP="yes" if stop_at_sleep else "",
            STDIN=stdin,
        )
        commands = (self.node.text("/harness/commands") or "").splitlines()
        return Run(done.stdout.strip(), done.returncode < 0, tuple(line.split(" ", 1)[1] for line in commands))

    @property
    def pictures(self) -> Path:
        return self.node.path("/harness/pictures")

    def after_cut(self, run: Run, keep: Path) -> Iterator[tuple[str, Path]]:
        """What a power cut during `run` (made with pictures) could leave as /etc: a label and a directory below `keep`.

        Directories are equal to none yielded before. Journaling file systems and jffs2 keep the order of names, so the
        names are those after some command; a file's bytes are certain only when a `sync` came after they were written.
        """
        seen: set[str] = set()
        synced: set[str] = set()
        states = [*(self.pictures / str(n) for n in range(1, len(run.commands) + 1)), self.node.path("/etc")]
        for index, state in enumerate(states):
            if index == 0 or run.commands[index - 1].startswith("sync"):
                synced = {hash_of(path) for path in files(state)}
            for tear in ("whole", "empty", "half"):
                target = keep / f"{index:03}-{tear}"
                shutil.copytree(state, target, symlinks=True)
                if tear != "whole" and not _tear(target, synced, tear):
                    shutil.rmtree(target)
                    continue
                picture = fingerprint(target)
                if picture in seen:
                    shutil.rmtree(target)
                    continue
                seen.add(picture)
                before = run.commands[index] if index < len(run.commands) else "the end"
                yield f"cut before {index + 1} `{before}`, {tear}", target


def files(root: Path) -> list[Path]:
    return sorted(path for path in root.rglob("*") if path.is_file() and not path.is_symlink())


def hash_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def fingerprint(root: Path) -> str:
    """Names, kinds, modes and content of everything below, as one hash."""
    lines = []
    for path in sorted(root.rglob("*")):
        if path.is_symlink():
            lines.append(f"{path.relative_to(root)} -> {path.readlink()}")
        else:
            what = hash_of(path) if path.is_file() else "directory"
            lines.append(f"{path.relative_to(root)} {path.stat().st_mode:o} {what}")
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _tear(root: Path, synced: set[str], how: str) -> bool:
    """Cut the content no sync has secured; whether there was any."""
    torn = False
    for path in files(root):
        content = path.read_bytes()
        if content and hash_of(path) not in synced:
            path.write_bytes(b"" if how == "empty" else content[: len(content) // 2])
            torn = True
    return torn
