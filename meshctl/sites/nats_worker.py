"""The permanent worker of a site, at its NATS leaf node: answers requests, executes stored orders, publishes events.

Four loops, one thread each. A request is answered by the same code as on an SSH uplink (`worker`). An order is fetched
from the hub's work queue, checked, and executed by `runner`; it is acknowledged once its run is started or refused, so
a worker that is killed gets it again, and a run that is known is not started twice. Events go from the runs' files into
the stream of the leaf node, from where each was published up to, whether or not there is an uplink.
"""

from __future__ import annotations

import base64
import io
import json
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from meshctl.device.authentication import sign
from meshctl.device.connection import Credentials, fingerprint_of
from meshctl.device.trust import parse_key
from meshctl.errors import InputError, MeshctlError, Unreachable
from meshctl.sites import runner
from meshctl.sites.chunks import HEADER, Assembler, StoredMessage, parse_chunk
from meshctl.sites.envelope import (
    EVENTS,
    REPLY,
    REQUEST,
    EnvelopeRefused,
    opened_by_worker,
    sealed_for_reply,
    signed,
    verified,
)
from meshctl.sites.nats_client import NatsClient
from meshctl.sites.nats_errors import NatsLost
from meshctl.sites.order import (
    ClockBehind,
    Order,
    OrderRefused,
    SignedOrder,
    checked_order,
    images_sha256,
    operator_keys,
)
from meshctl.sites.protocol import BEAT_S, MAX_EVENTS_BYTES, encode
from meshctl.sites.runs import RunDirectory, SiteDirectory, read_json, replace_bytes, write_json
from meshctl.sites.subjects import CONSUMER, SiteSubjects, stream_settings
from meshctl.sites.worker import Worker, run_command
from meshctl.wording import counted

if TYPE_CHECKING:
    import subprocess

    from nats.aio.msg import Msg

# How long events wait at the leaf node for an uplink.
KEPT_DAYS = 90
MAX_STREAM_BYTES = 64 << 20
_PUBLISH_S = 0.25
# How often the stream is checked for a loss.
_CHECK_S = 30.0
# More messages than a worker stores before it records their numbers.
_UNRECORDED = 1000
_CLOCK_RETRY_S = 30.0
_RETRY_S = 1.0
# A loop that fails again after so long has worked in between: the same reason is a new one.
_WORKED_S = 60.0
# Requests that change what the worker is, or that NATS has another way for.
_NOT_OVER_NATS = ("install", "start", "follow")


@dataclass(slots=True)
class NatsWorker:
    """Serves a site through `client`, which is connected to its leaf node. `hub` is the hub's JetStream domain."""

    directory: SiteDirectory
    environ: Mapping[str, str]
    client: NatsClient
    hub: str
    clock: Callable[[], float] = time.time
    _runners: list[subprocess.Popen[bytes]] = field(default_factory=list)
    # held while a run starts: until its process is recorded it looks dead
    _starting: threading.Lock = field(default_factory=threading.Lock)
    _published: set[str] = field(default_factory=set)

    @property
    def _subjects(self) -> SiteSubjects:
        return SiteSubjects(self.directory.fleet, self.directory.site)

    def serve(self) -> None:
        """Serve until the process is ended. Raises InputError for a site without a key, and NatsLost once the server
        has ended the connection for good: systemd starts a new worker, which connects again."""
        if not self.directory.key.exists():
            name = self.directory.site
            raise InputError(f"{self.directory.key}: missing", hint=f"run `meshctl sites install {name}`")
        self.directory.clean()
        loops = (self._beats, self._asks, self._orders, self._events)
        threads = [
            threading.Thread(target=self._repeat, args=(loop,), name=loop.__name__, daemon=True) for loop in loops
        ]
        # first: what the threads report belongs after it
        _log(f"serving {self.directory.fleet}/{self.directory.site}")
        for thread in threads:
            thread.start()
        while not (reason := self.client.closed_by):
            time.sleep(_RETRY_S)
        raise NatsLost(f"the leaf node closed the connection: {reason}")

    def _repeat(self, loop: Callable[[], None]) -> None:
        complaint = Complaint()
        while True:
            began_s, text = time.monotonic(), ""
            try:
                loop()
            except MeshctlError as error:
                text = str(error)
            except OSError as error:
                text = f"{error.filename or 'gateway'}: {error.strerror or error}"
            if time.monotonic() - began_s > _WORKED_S:
                complaint("")
            complaint(text)
            time.sleep(_RETRY_S)

    def _beats(self) -> None:
        while True:
            self.client.publish(self._subjects.beat, b"")
            time.sleep(BEAT_S)

    # -- requests

    def _asks(self) -> None:
        assembler = Assembler()
        with self.client.listening(self._subjects.ask) as received:
            while True:
                message = received.get()
                try:
                    whole = assembler.add(parse_chunk((message.headers or {}).get(HEADER, ""), message.data))
                except ValueError:
                    continue
                if whole is not None:
                    threading.Thread(target=self._answer, args=(whole, message), daemon=True).start()

    def _answer(self, data: bytes, message: Msg) -> None:
        try:
            value = verified(REQUEST, self._opened(data), self._operators(), "an operator")
            if (value["fleet"], value["site"]) != (self.directory.fleet, self.directory.site):
                raise EnvelopeRefused(f"a request for {value['fleet']}/{value['site']}")
            request, nonce, reply_to = dict(value["request"]), str(value["nonce"]), str(value["reply_to"])
        except (MeshctlError, KeyError, TypeError, ValueError) as error:
            # not answered: nothing proves who sent it
            _log(f"request refused: {error}")
            return
        replies = _Replies(self, message.reply, nonce, reply_to)
        if request.get("do") in _NOT_OVER_NATS:
            request = {"do": f"{request['do']} over NATS"}
        requests = replies.until_answered(encode(request))
        # a plan waits there for its order, for some minutes
        Worker(self.directory, self.environ, requests, replies).serve()

    def _operators(self) -> tuple[Any, ...]:
        return operator_keys(self.directory.operators())

    def _opened(self, data: bytes) -> bytes:
        return opened_by_worker(data, self.directory.key.read_bytes())

    def sign(self, data: bytes) -> tuple[str, bytes]:
        """Sign with the worker's key."""
        public = self.directory.key.with_name(f"{self.directory.key.name}.pub").read_text(encoding="utf-8")
        fingerprint = fingerprint_of(parse_key(public).blob)
        found = sign(Credentials((self.directory.key,), use_agent=False), (fingerprint,), data)
        if found is None:
            raise InputError(f"{self.directory.key} is not the key of {self.directory.key}.pub")
        own, signature = found
        return f"{own.key_type} {own.base64}", signature

    # -- orders

    def _orders(self) -> None:
        assembler = Assembler()
        pieces: dict[str, list[StoredMessage]] = {}
        subjects = self._subjects
        complaint = Complaint("no orders from the hub: ", "orders from the hub again")
        for stored in self.client.work(subjects.order_stream, subjects.orders, self.hub, CONSUMER, complaint):
            pieces.setdefault(stored.chunk.message, []).append(stored)
            whole = assembler.add(stored.chunk)
            if whole is None:
                continue
            taken = pieces.pop(stored.chunk.message)
            try:
                self._execute(whole)
            except ClockBehind as error:
                _log(f"{error}; the order waits until the clock is right")
                for each in taken:
                    each.later(_CLOCK_RETRY_S)
                continue
            except (MeshctlError, KeyError, TypeError, ValueError) as error:
                # nothing proves whose it is
                _log(f"order refused: {error}")
            for each in taken:
                each.acknowledge()

    def _execute(self, data: bytes) -> None:
        """Start the run of an order, or record why not. Raises MeshctlError for one that is no operator's."""
        message = json.loads(self._opened(data))
        signed_order = SignedOrder(str(message["order"]), str(message["key"]), str(message["signature"]))
        fleet, site = self.directory.fleet, self.directory.site
        order = checked_order(signed_order, self._operators(), fleet=fleet, site=site)
        run = self.directory.run(order.run)
        if run.order.exists() or run.refused.exists() or self.directory.has_forgotten(order.run):
            return
        try:
            order.check_time(self.clock())
            self._prepare(run, order, message)
            with self._starting:
                self._runners.append(runner.start(self.directory, signed_order, self.environ))
            _log(f"run {order.run} of {order.operator} ({order.command}) is started")
        except ClockBehind:
            raise
        except MeshctlError as error:
            run.refuse(order.operator, order.command, error)
            _log(f"run {order.run} of {order.operator} ({order.command}) is refused: {error}")

    def _prepare(self, run: RunDirectory, order: Order, message: Mapping[str, Any]) -> None:
        """Unpack what came with an order whose plan is not here, or not anymore, or in part: after a full disk, or a
        power cut in between."""
        images = {str(path): str(sha256) for path, sha256 in dict(message["images"]).items()}
        if order.expires_s is None:
            raise OrderRefused("an order without an expiry cannot wait for its site")
        if order.images_sha256 != images_sha256(images):
            raise OrderRefused("the order is for other firmware images than those it came with")
        is_whole = (run.part_sha256(), run.plan_sha256()) == (order.part_sha256, order.plan_sha256)
        if run.inventory.exists() and is_whole and (run.replaced.exists() or not order.reply_to):
            return
        run.discard()
        part = base64.b64decode(str(message["part"]), validate=True)
        if missing := self.directory.missing_images(images.values()):
            raise OrderRefused(
                f"not at this site: {counted(len(missing), 'firmware image')}", hint="plan again while it is online"
            )
        run.create(part, {path: self.directory.image(sha256) for path, sha256 in images.items()})
        run.plan.write_text(str(message["plan"]), encoding="utf-8")
        if order.reply_to:
            options = ["--reconnect", "-i", str(run.inventory), *runner.key_options(self.directory)]
            run_command(self.directory, run, self.environ, "apply", str(run.plan), "--dry-run", "--json", *options)
            replaced = json.dumps(run.taken_replaced()).encode()
            replace_bytes(run.replaced, sealed_for_reply(replaced, order.reply_to))

    # -- events

    def _events(self) -> None:
        subjects = self._subjects
        self.client.ensure_stream(
            name=subjects.run_stream, subjects=[subjects.runs], **stream_settings(KEPT_DAYS, MAX_STREAM_BYTES)
        )
        checked_s = -math.inf
        while True:
            if time.monotonic() - checked_s >= _CHECK_S:
                self._publish_what_was_lost()
                checked_s = time.monotonic()
            self._runners = [each for each in self._runners if each.poll() is None]
            for run in self._runs():
                if run.path.name not in self._published:
                    self._publish(run)
            time.sleep(_PUBLISH_S)

    def _runs(self) -> Iterator[RunDirectory]:
        return map(RunDirectory, (self.directory.root / "runs").glob("*"))

    def _publish_what_was_lost(self) -> None:
        """After the leaf node has lost its stream, publish all runs again, since the hub may not have copied them. Its
        copy continues after the last number that it has, so ours continue above it."""
        runs = list(self._runs())
        last = max((int(read_json(run.published).get("sequence", 0)) for run in runs), default=0)
        stream = self._subjects.run_stream
        if self.client.last_sequence(stream) >= last:
            return
        _log("the leaf node has lost its stream: the events of all runs are published again")
        self._published.clear()
        for run in runs:
            if run.published.exists():
                # the hub's copy would refuse a message whose name it has
                write_json(run.published, {"sequence": last, "lost": last})
        self.client.start_above(stream, last + _UNRECORDED)

    def _publish(self, run: RunDirectory) -> None:
        """Publish what is new of a run."""
        with self._starting:
            is_ordered = run.order.exists() or run.refused.exists()
        if not is_ordered:
            return
        state = read_json(run.published)
        offset, lost = int(state.get("offset", 0)), int(state.get("lost", 0))
        suffix = f"-{lost}" if lost else ""
        if not offset and run.replaced.exists():
            replaced = base64.b64encode(run.replaced.read_bytes()).decode()
            self._store(run, f"replaced{suffix}", {"end": 0, "replaced": replaced})
        while not state.get("is_over"):
            with self._starting:
                reply = run.next_reply(offset, MAX_EVENTS_BYTES)
            if reply is None:
                return
            value = {"end": reply["offset"], **{key: each for key, each in reply.items() if key != "offset"}}
            mark = "over" if "over" in reply else str(offset)
            sequence = self._store(run, f"{mark}{suffix}", value)
            offset = int(reply["offset"])
            state = {"offset": offset, "is_over": "over" in reply, "sequence": sequence, "lost": lost}
            write_json(run.published, state)
        self._published.add(run.path.name)

    def _store(self, run: RunDirectory, mark: str, value: Mapping[str, object]) -> int:
        """Store a message of a run; the same `mark` again, of a worker that was killed, is dropped by the server.
        Returns its number in the stream."""
        name = run.path.name
        whole = {"fleet": self.directory.fleet, "site": self.directory.site, "run": name, **value}
        return self.client.store(self._subjects.run(name), f"{name}-{mark}", signed(EVENTS, whole, self.sign))


class _Replies:
    """Sends what a `Worker` writes to the inbox of one request, signed and sealed, until it is answered."""

    def __init__(self, worker: NatsWorker, inbox: str, nonce: str, reply_to: str) -> None:
        self._worker = worker
        self._inbox = inbox
        self._nonce = nonce
        self._reply_to = reply_to
        self._count = 0
        self._is_answered = not inbox

    def until_answered(self, line: bytes) -> Iterator[bytes]:
        """The request, whose beats end with its answer."""
        yield line
        self._is_answered = True

    def write(self, data: bytes, /) -> int:
        if self._is_answered:
            raise io.UnsupportedOperation("the request is answered")
        self._count += 1
        value = {"nonce": self._nonce, "message": json.loads(data)}
        try:
            sealed = sealed_for_reply(signed(REPLY, value, self._worker.sign), self._reply_to)
            self._worker.client.send_chunks(self._inbox, f"{self._nonce}-{self._count}", sealed)
        except Unreachable as error:
            raise OSError(str(error)) from error
        return len(data)

    def flush(self) -> None:
        """Each line is sent as it is written."""


@dataclass(slots=True)
class Complaint:
    """Logs a reason once while it stays the same, which may be for days; an empty one ends it."""

    prefix: str = ""
    ended: str = ""
    _last: str = ""

    def __call__(self, reason: str) -> None:
        line = f"{self.prefix}{reason}" if reason else self.ended
        if reason != self._last and line:
            _log(line)
        self._last = reason


def _log(text: str) -> None:
    # one write: several threads log, and print writes the end of the line apart
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
