"""The worker at a site: requests on standard input, replies on standard output, until either is closed.

It keeps nothing in memory: a run belongs to its own processes (`runner`) and its directory (`runs`), and another
worker process, over the next uplink, finds it there. `plan` and `apply` are the commands that an operator would type
at the gateway.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import subprocess
import threading
import time
from collections.abc import Iterable, Mapping
from pathlib import PurePosixPath
from typing import Any, BinaryIO, Protocol

from meshctl import __version__
from meshctl.device.connection import fingerprint_of
from meshctl.errors import InputError, MeshctlError
from meshctl.sites import runner
from meshctl.sites.order import SignedOrder, operator_keys
from meshctl.sites.protocol import BEAT_S, MAX_EVENTS_BYTES, PROTOCOL, WorkerError, decode, encode, error_message
from meshctl.sites.runs import RunDirectory, SiteDirectory

_POLL_S = 0.25
# How long a plan waits for an order whose uplink was lost.
LINGER_S = 600.0
_MAX_ERROR_LINES = 20


class ReplyStream(Protocol):
    """Where replies are written, whole lines. Raises OSError or ValueError once no one reads them."""

    def write(self, data: bytes, /) -> object: ...

    def flush(self) -> None: ...


class Worker:
    """Serves one uplink. `environ` is the process environment."""

    def __init__(
        self, directory: SiteDirectory, environ: Mapping[str, str], requests: Iterable[bytes], out: ReplyStream
    ) -> None:
        self._directory = directory
        self._environ = environ
        self._requests = requests
        self._out = out
        self._lock = threading.Lock()
        # reaped, so that the process of a run that was killed does not look alive
        self._runners: list[subprocess.Popen[bytes]] = []
        self._planned: list[RunDirectory] = []
        # whether the operator said that no order will come
        self._is_finished = False
        self._is_lost = False

    def serve(self) -> None:
        """Answer requests until the end of the input."""
        self._directory.root.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._directory.clean()
        threading.Thread(target=self._beat, name="beat", daemon=True).start()
        for line in self._requests:
            try:
                self._answer(decode(line))
            except MeshctlError as error:
                self._send(error_message(error))
            except (KeyError, TypeError, ValueError) as error:
                self._send(error_message(InputError(f"invalid request: {type(error).__name__}: {error}")))
            except OSError as error:
                self._send(error_message(MeshctlError(f"{error.filename or 'gateway'}: {error.strerror or error}")))
        self._forget_planned()
        # its owner may close the stream now
        with self._lock:
            self._is_lost = True

    def _forget_planned(self) -> None:
        """Delete what was planned over this uplink and is not ordered, since it has secrets. After an uplink that was
        lost, the next one may bring the order: it has some minutes."""
        until_s = time.monotonic() + (0.0 if self._is_finished else LINGER_S)
        while left := [run for run in self._planned if run.inventory.exists() and not run.order.exists()]:
            if time.monotonic() >= until_s:
                for run in left:
                    run.discard()
            time.sleep(_POLL_S)

    def _answer(self, request: Mapping[str, Any]) -> None:
        match request["do"]:
            case "hello":
                self._reply(self._hello())
            case "install":
                self._reply({"public_key": self._directory.install(tuple(map(str, request["operators"])))})
            case "images":
                self._reply({"missing": self._directory.missing_images(tuple(map(str, request["sha256"])))})
            case "plan":
                self._reply(self._plan(request))
            case "start":
                self._reply(self._start(request))
            case "follow":
                self._follow(self._directory.run(str(request["run"])), int(request["offset"]))
            case "events":
                run = self._directory.run(str(request["run"]))
                self._reply(run.next_reply(int(request["offset"]), MAX_EVENTS_BYTES) or {})
            case "stop":
                self._reply({"stopping": runner.stop(self._directory.run(str(request["run"])))})
            case "status":
                self._reply(self._status(request))
            case "forgotten":
                self._reply({"forgotten": self._directory.has_forgotten(str(request["run"]))})
            case "image":
                self._reply({"size": self._image(request)})
            case "finish":
                self._is_finished = True
                self._finish(tuple(map(str, request.get("runs", ()))))
            case unknown:
                raise InputError(f"unknown request {unknown!r}", hint="run `meshctl sites install`")

    def _hello(self) -> dict[str, object]:
        self._reap()
        return {
            "protocol": PROTOCOL,
            "meshctl": __version__,
            "site": f"{self._directory.fleet}/{self._directory.site}",
            "directory": str(self._directory.root),
            "operators": [fingerprint_of(key.blob) for key in operator_keys(self._directory.operators())],
            "runs": [
                {"run": each.run, "state": each.state, "operator": each.operator, "command": each.command,
                 "began_s": each.began_s}
                for each in self._directory.runs()
            ],
        }  # fmt: skip

    def _plan(self, request: Mapping[str, Any]) -> dict[str, object]:
        """Unpack the site's part of the inventory and plan, or find out what still applies of the saved plan `agreed`;
        the plan's text, as `meshctl plan --json` prints it, and what its nodes have now, which the site does not keep.
        """
        run = self._directory.run(str(request["run"]))
        images = {str(path): self._directory.image(_file_name(sha256)) for path, sha256 in request["images"].items()}
        self._planned.append(run)
        run.create(_bytes_of(request["part"]), images)
        options = ["-i", str(run.inventory), *runner.key_options(self._directory), *map(str, request["options"])]
        if agreed := str(request.get("agreed", "")):
            run.plan.write_text(agreed, encoding="utf-8")
            done = self._command(run, "apply", str(run.plan), "--dry-run", "--json", *options)
            text = done.stdout.decode("utf-8", "replace")
        else:
            words = [*map(str, request["nodes"]), "--out", str(run.plan), "--brief"]
            done = self._command(run, "plan", *words, *options)
            text = run.plan.read_text(encoding="utf-8") if run.plan.exists() else ""
        if not text.strip():
            run.forget_secrets()
            raise _failure(done)
        return {"plan": text, "replaced": run.taken_replaced()}

    def _status(self, request: Mapping[str, Any]) -> dict[str, object]:
        """The site's status, as `meshctl status --json` prints it."""
        run = self._directory.run(str(request["run"]))
        run.create(_bytes_of(request["part"]), {})
        try:
            words = [*map(str, request["nodes"]), "-i", str(run.inventory), "--json", *map(str, request["options"])]
            done = self._command(run, "status", *words, *runner.key_options(self._directory))
        finally:
            run.discard()
        if not done.stdout.strip():
            raise _failure(done)
        return {"status": done.stdout.decode("utf-8", "replace"), "exit": done.returncode}

    def _image(self, request: Mapping[str, Any]) -> int:
        """Take a piece of a firmware image; returns how much of it is here."""
        new = self._directory.image(f".{_file_name(request['sha256'])}")
        new.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        size = new.stat().st_size if new.exists() else 0
        data = _bytes_of(request["data"])
        if data and int(request["offset"]) == size:
            with new.open("ab") as file:
                file.write(data)
            size += len(data)
        if request.get("is_last"):
            with new.open("rb") as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()
            if found != request["sha256"]:
                new.unlink()
                raise InputError("the firmware image was damaged on its way", hint="repeat the command")
            new.replace(self._directory.image(found))
        return size

    def _finish(self, runs: tuple[str, ...]) -> None:
        """Delete these plans of an operator who will not order them."""
        for name in runs:
            run = self._directory.run(name)
            if run.inventory.exists() and not run.order.exists() and not run.refused.exists():
                run.discard()

    def _command(self, run: RunDirectory, *words: str) -> subprocess.CompletedProcess[bytes]:
        return run_command(self._directory, run, self._environ, *words)

    def _start(self, request: Mapping[str, Any]) -> dict[str, object]:
        signed = SignedOrder(str(request["order"]), str(request["key"]), str(request["signature"]))
        self._runners.append(runner.start(self._directory, signed, self._environ))
        return {"started": True}

    def _follow(self, run: RunDirectory, offset: int) -> None:
        """Send the run's events from `offset` (bytes) on until it is over."""
        if not run.order.exists() and not run.refused.exists():
            raise InputError(f"run {run.path.name} has not been started at this site")
        while not self._is_lost:
            self._reap()
            reply = run.next_reply(offset, MAX_EVENTS_BYTES)
            if reply is None:
                time.sleep(_POLL_S)
                continue
            offset = int(reply["offset"])
            self._reply(reply)
            if "over" in reply:
                return

    def _reap(self) -> None:
        self._runners = [each for each in self._runners if each.poll() is None]

    def _reply(self, reply: Mapping[str, object]) -> None:
        self._send({"reply": dict(reply)})

    def _send(self, message: Mapping[str, object]) -> None:
        try:
            with self._lock:
                if not self._is_lost:
                    self._out.write(encode(message) + b"\n")
                    self._out.flush()
        except (OSError, ValueError):
            # the input ends, too; the runs are not this process's
            self._is_lost = True

    def _beat(self) -> None:
        while not self._is_lost:
            time.sleep(BEAT_S)
            self._send({"beat": BEAT_S})


def run_command(
    directory: SiteDirectory, run: RunDirectory, environ: Mapping[str, str], *words: str
) -> subprocess.CompletedProcess[bytes]:
    """Run a command of meshctl at the site, with the inventory of a run."""
    return subprocess.run(
        runner.meshctl_command(*words),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        env=runner.environment(directory, run, environ),
        check=False,
    )


def _bytes_of(text: object) -> bytes:
    try:
        return base64.b64decode(str(text), validate=True)
    except binascii.Error as error:
        raise InputError(f"invalid request: {error}") from error


def _file_name(text: object) -> str:
    name = str(text)
    if PurePosixPath(name).name != name:
        raise InputError(f"invalid request: {name!r} is no file name")
    return name


def _failure(done: subprocess.CompletedProcess[bytes]) -> WorkerError:
    """The last output of a failed command, as its error."""
    error_lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
    errors = [line.removeprefix("error: ") for line in error_lines if not line.startswith("hint: ")][:_MAX_ERROR_LINES]
    hints = [line.removeprefix("hint: ") for line in error_lines if line.startswith("hint: ")]
    text = "\n".join(errors) or f"the command exited with {done.returncode} and printed nothing"
    return WorkerError(text, hint=hints[-1] if hints else "")


def serve(name: str, environ: Mapping[str, str], requests: BinaryIO, out: BinaryIO) -> None:
    """Serve the site `FLEET/SITE` on these streams."""
    Worker(SiteDirectory.of(name, environ), environ, requests, out).serve()


def execute(name: str, run: str, environ: Mapping[str, str]) -> int:
    """Execute a started run to its end; returns its exit status."""
    directory = SiteDirectory.of(name, environ)
    return runner.execute(directory, directory.run(run), environ)
