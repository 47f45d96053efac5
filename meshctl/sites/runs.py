"""A site's directory on its gateway: the worker's key, the operators' keys, and one directory for each run.

id_ed25519           the worker's key; its public part is `worker_key` in the inventory
operators            public keys that may sign orders, as in authorized_keys
forgotten            the ids of runs whose directories were deleted to keep no more than MAX_RUNS
lock                 held while a run is executed: its content says which
images/SHA256        firmware images, kept for later runs
state/               the journal of the site's runs
runs/RUN/inventory/  the site's part of the inventory, with secrets; deleted when the run is over
runs/RUN/plan.json   the plan that was shown to the operator
runs/RUN/order.json  the signed order; a run without one was only prepared
runs/RUN/refused.json why a stored order was not executed, instead
runs/RUN/events      the run's events, one JSON object a line
runs/RUN/over.json   how the run ended
runs/RUN/replaced.age what a run replaces that was ordered while its site was offline, sealed for the operator
runs/RUN/published.json  how much of that is in the leaf node's stream
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import json
import os
import re
import shutil
import tarfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from meshctl.device.authentication import new_key_pair
from meshctl.errors import InputError, MeshctlError
from meshctl.fleet.process import is_process_alive
from meshctl.sites.events import condensed
from meshctl.sites.part import REPLACED_FILE

# A plan that was prepared longer ago is made again before it is executed; its inventory, with secrets, is deleted.
PREPARED_S = 3600.0
MAX_RUNS = 50
MAX_IMAGES = 8
_MAX_FORGOTTEN = 10_000
_RUN_ID = re.compile(r"[0-9a-f]{16}")


class SiteBusy(MeshctlError):
    """Another run is in progress at the site."""


@dataclass(frozen=True, slots=True)
class RunState:
    """`state` is `prepared`, `in progress`, `over`, `refused`, or `interrupted`: the gateway or the run's process
    died."""

    run: str
    state: str
    operator: str = ""
    command: str = ""
    began_s: float = 0.0


@dataclass(frozen=True, slots=True)
class SiteDirectory:
    """The directory of one site on its gateway; readable by its owner only."""

    root: Path

    @classmethod
    def of(cls, name: str, environ: Mapping[str, str]) -> SiteDirectory:
        """`name` is `FLEET/SITE`. Below $XDG_STATE_HOME/meshctl/sites. Raises InputError for any other name."""
        parts = name.split("/")
        if len(parts) != 2 or not all(re.fullmatch(r"[A-Za-z0-9._-]+", part) and part.strip(".") for part in parts):
            raise InputError(f"{name!r}: expected FLEET/SITE")
        state = environ.get("XDG_STATE_HOME", "")
        home = Path(state) if state.startswith("/") else Path(environ.get("HOME", "/"), ".local/state")
        return cls(home / "meshctl" / "sites" / parts[0] / parts[1])

    @property
    def fleet(self) -> str:
        return self.root.parent.name

    @property
    def site(self) -> str:
        return self.root.name

    @property
    def key(self) -> Path:
        return self.root / "id_ed25519"

    @property
    def state(self) -> Path:
        return self.root / "state"

    def operators(self) -> str:
        try:
            return (self.root / "operators").read_text(encoding="utf-8")
        except OSError:
            return ""

    def install(self, operators: Iterable[str]) -> str:
        """Let these public keys sign orders; returns the worker's public key, which is made if there is none."""
        self.root.mkdir(parents=True, exist_ok=True, mode=0o700)
        replace_text(self.root / "operators", "".join(f"{line}\n" for line in operators))
        public = self.key.with_name(f"{self.key.name}.pub")
        if not self.key.exists():
            private, shared = new_key_pair(f"meshctl-worker@{self.site}")
            with os.fdopen(os.open(self.key, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(private)
            public.write_text(f"{shared}\n", encoding="utf-8")
        return public.read_text(encoding="utf-8").strip()

    def image(self, sha256: str) -> Path:
        return self.root / "images" / sha256

    def missing_images(self, wanted: Iterable[str]) -> list[str]:
        return [sha256 for sha256 in wanted if not self.image(sha256).is_file()]

    def run(self, run: str) -> RunDirectory:
        """Raises InputError for anything but a run's id, which becomes part of a path."""
        if not _RUN_ID.fullmatch(run):
            raise InputError(f"{run!r}: expected the id of a run, 16 hexadecimal digits")
        return RunDirectory(self.root / "runs" / run)

    def runs(self) -> tuple[RunState, ...]:
        """The runs that are known, the newest first."""
        directories = (RunDirectory(path) for path in (self.root / "runs").glob("*") if _RUN_ID.fullmatch(path.name))
        return tuple(sorted((each.state() for each in directories), key=lambda each: each.began_s, reverse=True))

    def clean(self) -> None:
        """Delete what no run needs anymore, secrets first."""
        for number, state in enumerate(self.runs()):
            directory = self.run(state.run)
            is_old = state.state == "prepared" and time.time() - state.began_s > PREPARED_S
            is_one_too_many = number >= MAX_RUNS and state.state != "in progress"
            if is_one_too_many and state.state != "prepared":
                self._note_forgotten(state.run)
            if is_old or is_one_too_many:
                directory.discard()
            elif state.state == "interrupted":
                directory.forget_secrets()
        images = sorted((self.root / "images").glob("*"), key=lambda path: path.stat().st_mtime, reverse=True)
        for path in images[MAX_IMAGES:]:
            path.unlink(missing_ok=True)

    def _note_forgotten(self, run: str) -> None:
        lines = [*_text(self._forgotten).splitlines(), run][-_MAX_FORGOTTEN:]
        replace_text(self._forgotten, "".join(f"{line}\n" for line in lines))

    def has_forgotten(self, run: str) -> bool:
        """Whether a run was started here of which nothing is kept."""
        return run in _text(self._forgotten).splitlines()

    @property
    def _forgotten(self) -> Path:
        return self.root / "forgotten"

    def lock(self, holder: Mapping[str, object]) -> int:
        """Take the site's lock; returns the open file that holds it, for the run's processes to inherit.

        Raises SiteBusy with what the holder wrote.
        """
        self.root.mkdir(parents=True, exist_ok=True, mode=0o700)
        file = os.open(self.root / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            text = os.read(file, 4096).decode("utf-8", "replace")
            os.close(file)
            raise SiteBusy(_busy_text(text)) from error
        os.ftruncate(file, 0)
        os.write(file, json.dumps(dict(holder)).encode())
        return file


def _busy_text(text: str) -> str:
    try:
        holder = json.loads(text)
        return f"run {holder['run']} of {holder['operator']} ({holder['command']}) is in progress at this site"
    except (ValueError, KeyError, TypeError):
        return "another run is in progress at this site"


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """The directory of one run."""

    path: Path

    @property
    def inventory(self) -> Path:
        return self.path / "inventory"

    @property
    def plan(self) -> Path:
        return self.path / "plan.json"

    @property
    def events(self) -> Path:
        return self.path / "events"

    @property
    def errors(self) -> Path:
        return self.path / "errors"

    @property
    def order(self) -> Path:
        return self.path / "order.json"

    @property
    def refused(self) -> Path:
        return self.path / "refused.json"

    @property
    def replaced(self) -> Path:
        return self.path / "replaced.age"

    @property
    def published(self) -> Path:
        return self.path / "published.json"

    @property
    def process(self) -> Path:
        """The runner, as the worker that started it names it."""
        return self.path / "process"

    @property
    def processes(self) -> Path:
        """The runner and the command that changes nodes, as the runner names them."""
        return self.path / "processes"

    @property
    def over(self) -> Path:
        return self.path / "over.json"

    def create(self, archive: bytes, images: Mapping[str, Path]) -> None:
        """Make the directory with the part of the inventory in `archive`; `images` are linked by their paths in it.

        Raises InputError if the run is there already, or the archive reaches out of its directory.
        """
        try:
            self.inventory.mkdir(parents=True, mode=0o700)
        except FileExistsError:
            raise InputError(f"run {self.path.name} is at this site already") from None
        try:
            for name, content, mode in _files_of(archive):
                target = self._inside(name)
                target.write_bytes(content)
                target.chmod(mode)
            for path, image in images.items():
                target = self._inside(path)
                # a hard link: an image that is cleaned up in between stays for this run
                os.link(image, target)
        except (tarfile.TarError, OSError, InputError) as error:
            self.discard()
            raise InputError(f"the inventory cannot be unpacked: {error}") from error
        (self.path / "part").write_text(hashlib.sha256(archive).hexdigest())

    def _inside(self, name: str) -> Path:
        """The path of a file in the inventory, whose folder is made. Raises InputError for one outside."""
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or not path.name:
            raise InputError(f"{name}: outside the inventory")
        target = self.inventory / path
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def part_sha256(self) -> str:
        return _text(self.path / "part")

    def plan_sha256(self) -> str:
        try:
            return hashlib.sha256(self.plan.read_bytes()).hexdigest()
        except OSError:
            return ""

    def state(self) -> RunState:
        run = self.path.name
        try:
            began_s = self.path.stat().st_mtime if not self.order.exists() else self.order.stat().st_mtime
        except OSError:
            began_s = 0.0
        if refused := read_json(self.refused):
            return RunState(
                run, "refused", str(refused["operator"]), str(refused["command"]), float(refused["refused_s"])
            )
        order = read_json(self.order)
        if not order:
            return RunState(run, "prepared", began_s=began_s)
        state = "over" if self.over.exists() else "in progress" if self.is_alive() else "interrupted"
        return RunState(run, state, str(order.get("operator", "")), str(order.get("command", "")), began_s)

    def is_alive(self) -> bool:
        """Whether one of the run's processes lives: the one that waits for its end, or the one that changes nodes."""
        return any(
            is_process_alive(line) for path in (self.process, self.processes) for line in _text(path).splitlines()
        )

    def taken_replaced(self) -> dict[str, Any]:
        """Node -> what the plan would replace on it, for the operator alone: it has the node's keys."""
        path = self.inventory / REPLACED_FILE
        found = read_json(path)
        path.unlink(missing_ok=True)
        return found

    def forget_secrets(self) -> None:
        shutil.rmtree(self.inventory, ignore_errors=True)

    def discard(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)

    def refuse(self, operator: str, command: str, error: MeshctlError) -> None:
        """Record that the run is never executed, also if its order is delivered again."""
        self.forget_secrets()
        self.path.mkdir(parents=True, exist_ok=True, mode=0o700)
        recorded = {"error": str(error), "hint": error.hint, "operator": operator, "command": command}
        write_json(self.refused, {**recorded, "refused_s": time.time()})

    def next_reply(self, offset: int, limit: int) -> dict[str, Any] | None:
        """What a follower that has `offset` bytes of the events gets next: events, or how the run ended (`over`)."""
        if refused := read_json(self.refused):
            error, hint = str(refused["error"]), str(refused["hint"])
            return {"offset": offset, "over": {"error": error, "hint": hint, "is_refused": True}}
        # its end is looked up before the events: those written before it are then read as well
        over, is_alive = read_json(self.over), self.is_alive()
        if events := self.new_events(offset, limit):
            return {"offset": offset + len(events), "events": condensed(events)}
        if over:
            return {"offset": offset, "over": over}
        if not is_alive and not self.over.exists():
            text = "the run's process ended without a result: the gateway was switched off, or it was killed"
            return {"offset": offset, "over": {"error": text, "hint": ""}}
        return None

    def new_events(self, offset: int, limit: int) -> bytes:
        """The complete lines after `offset` (bytes), at most about `limit` bytes."""
        try:
            with self.events.open("rb") as file:
                file.seek(offset)
                read = file.read(limit)
        except OSError:
            return b""
        return read[: read.rfind(b"\n") + 1]


def _files_of(archive: bytes) -> Iterator[tuple[str, bytes, int]]:
    """The regular files of a tar, which a part consists of: name, content, mode. (Python's own filter for archives came
    with 3.11.4, and Debian 12 has 3.11.2.)"""
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        for member in tar:
            content = tar.extractfile(member) if member.isreg() else None
            if content is None:
                raise InputError(f"{member.name}: not a regular file")
            yield member.name, content.read(), member.mode & 0o700


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


def read_json(path: Path) -> dict[str, Any]:
    """The object in a file; empty for a missing or damaged one."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write_json(path: Path, value: Mapping[str, object]) -> None:
    replace_text(path, json.dumps(dict(value)))


def replace_text(path: Path, text: str) -> None:
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, data: bytes) -> None:
    """Replace a file in one rename, so that a reader finds the whole of it, or of the earlier one."""
    new = path.with_name(f".{path.name}.new")
    with new.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)


@contextmanager
def closing(file: int) -> Iterator[int]:
    try:
        yield file
    finally:
        os.close(file)
