"""Render an inventory's templates in a separate process with limits on memory, time and output.

A template may come from an untrusted inventory. Jinja's sandbox prevents access to files and programs, but not that `{{
"A" * 10**10 }}` uses all memory or that nested loops run for hours. Checking single operators is not enough, as text
also grows through `~`, `center`, `join`, `replace` and formatting; only kernel limits cover everything. The shipped
templates are trusted and rendered in process.

`SandboxRenderer.text` sends a request to `meshctl.render.sandbox_worker`, which runs as long as the renderer; a worker
that exceeds a limit is replaced.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import select
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from meshctl.model import Secret

# Python with jinja2 needs about 100 MiB of address space; a node's configuration is about 10 KiB.
MEMORY_BYTES = 1024 * 1024 * 1024
# A template takes milliseconds of CPU time; the wall clock limit allows for a busy machine.
CPU_S = 10
WAIT_S = 60.0
# The flash of a typical device is 16 MiB.
OUTPUT_BYTES = 4 * 1024 * 1024
LENGTH_BYTES = 8


class LimitExceeded(Exception):
    """A template exceeded a limit; the message says which."""


class SandboxRenderer:
    """One worker process and the requests to it. Thread-safe."""

    def __init__(self, *, cpu_s: int = CPU_S, memory_bytes: int = MEMORY_BYTES, wait_s: float = WAIT_S) -> None:
        self._limits = (str(cpu_s), str(memory_bytes))
        self._cpu_s, self._memory_bytes, self._wait_s = cpu_s, memory_bytes, wait_s
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._end: Callable[[], object] = lambda: None

    def text(self, *request: object) -> dict[str, Any]:
        """The worker's answer to a request. Raises LimitExceeded."""
        with self._lock:
            process = self._running()
            try:
                return self._exchange(process, _pickled(request))
            except LimitExceeded:
                self._end()
                self._process = None
                raise

    def _cause_of_death(self, process: subprocess.Popen[bytes]) -> str:
        status = process.wait()
        if status == -signal.SIGXCPU:
            return f"the template exceeds {self._cpu_s} s of CPU time"
        assert process.stderr is not None
        last = _last_line(process.stderr.read())
        if last.startswith("MemoryError") or status == -signal.SIGSEGV:
            return f"the template exceeds {self._memory_bytes >> 20} MiB of memory"
        return f"the rendering process ended with status {status}: {last}"

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "meshctl.render.sandbox_worker", *self._limits],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                # Ctrl-C goes to meshctl only
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
            )
            self._end = weakref.finalize(self, _stop, self._process)
        return self._process

    def _exchange(self, process: subprocess.Popen[bytes], request: bytes) -> dict[str, Any]:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(len(request).to_bytes(LENGTH_BYTES, "big") + request)
            process.stdin.flush()
            length = int.from_bytes(_read(process.stdout.fileno(), LENGTH_BYTES, self._wait_s), "big")
            if length > 2 * OUTPUT_BYTES:
                raise LimitExceeded(f"the template's output exceeds {OUTPUT_BYTES} bytes")
            answer: dict[str, Any] = json.loads(_read(process.stdout.fileno(), length, self._wait_s))
        except (EOFError, BrokenPipeError):
            raise LimitExceeded(self._cause_of_death(process)) from None
        except TimeoutError:
            raise LimitExceeded(f"the template does not finish within {self._wait_s:g} s") from None
        return answer


def _last_line(text: bytes) -> str:
    return (text.decode("utf-8", "replace").strip().splitlines() or ["no output"])[-1]


def _pickled(request: object) -> bytes:
    """Pickle a request for the worker, including secrets, which otherwise refuse to be serialized."""
    out = io.BytesIO()
    pickler = pickle.Pickler(out, pickle.HIGHEST_PROTOCOL)
    pickler.dispatch_table = {Secret: _secret_parts, MappingProxyType: _mapping_parts}
    pickler.dump(request)
    return out.getvalue()


def _secret_parts(secret: Secret) -> tuple[type[Secret], tuple[str]]:
    return Secret, (secret.reveal(),)


def _mapping_parts(mapping: Mapping[object, object]) -> tuple[Callable[..., object], tuple[dict[object, object]]]:
    return read_only, (dict(mapping),)


def read_only(mapping: dict[object, object]) -> Mapping[object, object]:
    """A named constructor of MappingProxyType for pickle."""
    return MappingProxyType(mapping)


def _read(descriptor: int, count: int, wait_s: float) -> bytes:
    """Read exactly `count` bytes. Raises EOFError at the end, TimeoutError after `wait_s` without data."""
    parts = []
    while count:
        ready, _, _ = select.select([descriptor], [], [], wait_s)
        if not ready:
            raise TimeoutError
        part = os.read(descriptor, min(count, 1 << 16))
        if not part:
            raise EOFError
        parts.append(part)
        count -= len(part)
    return b"".join(parts)


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Kill the worker, which has no state to lose."""
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            try:
                stream.close()
            except BrokenPipeError:
                # unsent output
                continue
