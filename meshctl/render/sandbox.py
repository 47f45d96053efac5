"""Templates of an inventory, rendered in a process of their own that is limited in memory, time and output.

A template may come with an untrusted inventory. Jinja's sandbox keeps it from files and programs; it does not keep
`{{ "A" * 10**10 }}` from taking all memory, or three nested loops from running for hours, and neither does a check of
single operators: text grows by `~`, `center`, `join`, `replace` and formats as well. Only the kernel bounds all of it.
Shipped templates are our own, and are rendered without this.

`Renderer.text` sends a request to `meshctl.render.sandbox_worker`, which lives as long as the renderer; a worker
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

# Python with jinja2 takes some 100 MiB of address space; a node's configuration is some 10 KiB.
MEMORY_BYTES = 1024 * 1024 * 1024
# A template takes milliseconds. Waiting is longer than computing: the machine may have much else to do.
CPU_S = 10
WAIT_S = 60.0
# OpenWrt's flash holds 16 MiB in all.
OUTPUT_BYTES = 4 * 1024 * 1024
LENGTH_BYTES = 8


class LimitExceeded(Exception):
    """A template exceeded a limit; the text says which."""


class SandboxRenderer:
    """One worker process and the requests to it. Safe to use from several threads."""

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
            return f"it does not end: it takes more than {self._cpu_s} s of processor time"
        assert process.stderr is not None
        last = _last_line(process.stderr.read())
        if last.startswith("MemoryError") or status == -signal.SIGSEGV:
            return f"it takes more than {self._memory_bytes >> 20} MiB of memory"
        return f"the process that renders it ended with status {status}: {last}"

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "meshctl.render.sandbox_worker", *self._limits],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                # Ctrl-C is for meshctl, which decides what is still finished
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
                raise LimitExceeded(f"it renders more than {OUTPUT_BYTES} bytes")
            answer: dict[str, Any] = json.loads(_read(process.stdout.fileno(), length, self._wait_s))
        except (EOFError, BrokenPipeError):
            raise LimitExceeded(self._cause_of_death(process)) from None
        except TimeoutError:
            raise LimitExceeded(f"it does not end within {self._wait_s:g} s") from None
        return answer


def _last_line(text: bytes) -> str:
    return (text.decode("utf-8", "replace").strip().splitlines() or ["it said nothing"])[-1]


def _pickled(request: object) -> bytes:
    """For our own worker's eyes: secrets, which refuse to be serialized, go with their value."""
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
    """What pickle cannot name itself."""
    return MappingProxyType(mapping)


def _read(descriptor: int, count: int, wait_s: float) -> bytes:
    """Exactly `count` bytes. Raises EOFError at the end, TimeoutError when none come for `wait_s`."""
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
    """It holds nothing that could be lost."""
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout, process.stderr):
        if stream is not None:
            try:
                stream.close()
            except BrokenPipeError:
                # what was left to write has no reader
                continue
