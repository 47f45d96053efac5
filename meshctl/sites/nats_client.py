"""A connection to a NATS server with JetStream, for threads: nats-py runs in an event loop of its own.

Needs nats-py (the extra `nats`) and nats-server 2.9 or newer. Every error is a MeshctlError; a server or a stream that
cannot be reached is a `NatsLost`.
"""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable, Coroutine, Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from meshctl.errors import Unreachable
from meshctl.sites.chunks import HEADER, Chunk, StoredMessage, chunks_of, parse_chunk
from meshctl.sites.nats_errors import HINT, NatsLost, Refusals, not_installed, translated
from meshctl.sites.nats_login import login_options, tls_context

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

CONNECT_S = 5.0
# of one exchange with a server
ANSWER_S = 5.0
_RECONNECT_S, _KEEPALIVE_S = 1.0, 5
# after how many fetches without a message a work queue is checked for a loss
_FETCHES = 6
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class NatsServer:
    """Where a server is, and our credentials there. `name` is what the server lists us as."""

    url: str
    credentials: Path | None = None
    ca: Path | None = None
    name: str = "meshctl"


class NatsClient:
    """A connection that is lost is made again in the background; meanwhile everything is `NatsLost`. So is a first one
    that fails; with `note` it is tried until it succeeds, and `note` gets why it fails, and then ""."""

    def __init__(self, server: NatsServer, *, note: Callable[[str], None] | None = None) -> None:
        self._server = server
        self.refusals = Refusals(server.url)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="nats", daemon=True)
        self._thread.start()
        try:
            self._client: Client = self._run(self._connect(note), CONNECT_S * 2 if note is None else None)
        except BaseException:
            self._end_loop()
            raise

    def _end_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.run_until_complete(_cancel_all())
        self._loop.close()

    async def _connect(self, note: Callable[[str], None] | None) -> Client:
        try:
            from nats.aio.client import Client
            from nats.errors import Error
        except ImportError as error:
            raise not_installed(error) from error
        options: dict[str, Any] = {
            "name": self._server.name,
            "connect_timeout": CONNECT_S,
            "reconnect_time_wait": _RECONNECT_S,
            "max_reconnect_attempts": -1,
            "ping_interval": _KEEPALIVE_S,
            "max_outstanding_pings": 2,
            # what is sent while the server is away is lost, not sent later by surprise
            "pending_size": -1,
            "error_cb": self.refusals.note,
            "inbox_prefix": b"_INBOX",
            **login_options(self._server.credentials),
        }
        if self._server.ca is not None:
            options["tls"] = tls_context(self._server.ca)
        while True:
            client = Client()
            try:
                # by itself it would try for ever, and without a word
                await asyncio.wait_for(client.connect(self._server.url, **options), CONNECT_S)
            except ImportError as error:
                # nats-py needs nkeys for credentials
                raise not_installed(error) from error
            except (TimeoutError, Error, OSError) as error:
                with suppress(Error, OSError):
                    await client.close()
                text = str(error) or f"no answer within {CONNECT_S:g} s{self.refusals.reason}"
                if note is None:
                    raise NatsLost(f"NATS server {self._server.url}: {text}", hint=HINT) from error
                note(text)
                await asyncio.sleep(_RECONNECT_S)
            else:
                if note is not None:
                    note("")
                return client

    def _run(self, work: Coroutine[Any, Any, _T], timeout_s: float | None = ANSWER_S * 2) -> _T:
        """Run in the event loop, and translate errors."""
        refused = self.refusals.count
        if self._loop.is_closed():
            work.close()
            raise NatsLost(f"NATS server {self._server.url}: the connection was closed")
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(timeout_s)
        except TimeoutError as error:
            future.cancel()
            self.refusals.check(refused)
            raise NatsLost(f"NATS server {self._server.url}: no answer", hint=HINT) from error
        except BaseException as error:
            known = translated(error, self._server.url)
            if known is None:
                raise
            raise known from error

    @property
    def is_connected(self) -> bool:
        return bool(self._client.is_connected)

    @property
    def closed_by(self) -> str:
        """Why the server has ended the connection for good, such as credentials that it no longer accepts; empty if it
        has not. Only a new client connects again."""
        return str(self._client.last_error or "no reason given") if self._client.is_closed else ""

    def _check_connected(self) -> None:
        if self.closed_by:
            raise NatsLost(f"NATS server {self._server.url} closed the connection: {self.closed_by}", hint=HINT)
        if not self.is_connected:
            raise NatsLost(f"NATS server {self._server.url}: the connection is lost", hint=HINT)

    def publish(self, subject: str, data: bytes) -> None:
        """Send a message that is not stored."""
        self._check_connected()
        self._run(self._client.publish(subject, data))

    def send_chunks(self, subject: str, message: str, data: bytes, reply: str = "") -> None:
        """Send a message of any size that is not stored."""
        self._check_connected()
        for chunk in chunks_of(message, data):
            self._run(self._client.publish(subject, chunk.data, reply=reply, headers={HEADER: chunk.header}))

    @contextmanager
    def listening(self, subject: str) -> Iterator[queue.Queue[Msg]]:
        """The messages of a subject while the block runs."""
        received: queue.Queue[Msg] = queue.Queue()

        async def put(message: Msg) -> None:
            received.put(message)

        subscription = self._run(self._client.subscribe(subject, cb=put))
        try:
            self._run(self._client.flush(int(ANSWER_S)))
            yield received
        finally:
            with suppress(Unreachable):
                self._run(subscription.unsubscribe())

    def new_inbox(self) -> str:
        return str(self._client.new_inbox())

    def _jetstream(self, domain: str) -> JetStreamContext:
        return self._client.jetstream(domain=domain or None, timeout=ANSWER_S)

    def ensure_stream(self, domain: str = "", **config: Any) -> bool:
        """Make a stream, unless there is one of this name; whether it was made."""
        from nats.js.errors import NotFoundError

        async def ensure() -> bool:
            js = self._jetstream(domain)
            try:
                await js.stream_info(config["name"])
            except NotFoundError:
                await js.add_stream(**config)
                return True
            return False

        self._check_connected()
        return self._run(ensure())

    def last_sequence(self, stream: str, domain: str = "") -> int:
        """The number of the last message that was stored in a stream."""
        self._check_connected()
        return int(self._run(self._jetstream(domain).stream_info(stream)).state.last_seq)

    def start_above(self, stream: str, sequence: int) -> None:
        """Number the messages of an empty stream from `sequence` + 1 on."""
        self._check_connected()
        self._run(self._jetstream("").purge_stream(stream, seq=sequence + 1))

    def ensure_mirror(self, stream: str, domain: str, **limits: Any) -> None:
        """Copy a stream of another JetStream domain, under its name, unless that is done already. A copy of a stream
        that was lost, and whose numbers began again, would wait for the next one: it is replaced."""
        from nats.js.api import ExternalStream, StreamSource

        external = ExternalStream(api=f"$JS.{domain}.API", deliver="")
        config = {"name": stream, "mirror": StreamSource(name=stream, external=external), **limits}
        if self.ensure_stream(**config):
            return
        copied = self.last_sequence(stream)
        try:
            is_lost = self.last_sequence(stream, domain) < copied
        except NatsLost:
            # its site is offline, or has no stream yet
            return
        if is_lost:
            self._run(self._jetstream("").delete_stream(stream))
            self.ensure_stream(**config)

    def store(self, subject: str, message: str, data: bytes, domain: str = "") -> int:
        """Store a message in the stream of its subject; returns its number there. The same `message` again changes
        nothing."""

        async def store() -> int:
            js, sequence = self._jetstream(domain), 0
            for chunk in chunks_of(message, data):
                headers = {HEADER: chunk.header, "Nats-Msg-Id": f"{message}-{chunk.number}"}
                sequence = (await js.publish(subject, chunk.data, headers=headers)).seq
            return sequence

        self._check_connected()
        return self._run(store(), None)

    def queued(self, stream: str, subject: str) -> int:
        """How many messages of a subject a stream has."""
        return sum(self.subjects(stream, subject).values())

    def subjects(self, stream: str, subject: str = ">") -> dict[str, int]:
        """The subjects of a stream that match, with the number of their messages; none without such a stream."""

        async def count() -> dict[str, int]:
            from nats.js.errors import NotFoundError

            try:
                info = await self._jetstream("").stream_info(stream, subjects_filter=subject)
            except NotFoundError:
                return {}
            return dict(info.state.subjects or {})

        self._check_connected()
        return self._run(count())

    def restart_consumer(self, stream: str, consumer: str) -> None:
        """Make the consumer of a stream that has lost its messages again: the stream numbers from 1, and the consumer
        would wait for the next number that it has not seen."""
        from nats.js.errors import NotFoundError

        async def restart() -> None:
            js = self._jetstream("")
            try:
                found = await js.consumer_info(stream, consumer)
                stored = (await js.stream_info(stream)).state.last_seq
            except NotFoundError:
                return
            if found.delivered is not None and found.delivered.stream_seq > stored:
                await js.delete_consumer(stream, consumer)
                await js.add_consumer(stream, found.config)

        self._check_connected()
        self._run(restart())

    def purge(self, stream: str, subject: str) -> int:
        """Delete the messages of a subject; how many there were."""
        found = self.queued(stream, subject)
        if found:
            self._run(self._jetstream("").purge_stream(stream, subject=subject))
        return found

    def work(
        self,
        stream: str,
        subject: str,
        domain: str,
        consumer: str,
        note: Callable[[str], None] = lambda reason: None,
    ) -> Iterator[StoredMessage]:
        """The messages of a work queue, forever, whether or not it can be reached, and after it was lost and made
        again. `note` gets why nothing can be fetched, and "" whenever it can."""
        from nats.errors import Error
        from nats.js.api import AckPolicy, ConsumerConfig
        from nats.js.errors import NotFoundError

        async def subscribe() -> JetStreamContext.PullSubscription:
            config = ConsumerConfig(ack_policy=AckPolicy.EXPLICIT, ack_wait=60, max_ack_pending=1000)
            return await self._jetstream(domain).pull_subscribe(subject, consumer, stream=stream, config=config)

        async def fetch(subscription: JetStreamContext.PullSubscription) -> list[Msg]:
            try:
                return await subscription.fetch(1, timeout=ANSWER_S)
            except TimeoutError:
                return []

        subscription, empty = None, 0
        while not self._loop.is_closed():
            try:
                self._check_connected()
                if subscription is None:
                    subscription, empty = self._run(subscribe()), 0
                    note("")
                messages = self._run(fetch(subscription), ANSWER_S * 3)
                empty = 0 if messages else empty + 1
                if empty and empty % _FETCHES == 0:
                    # fetching from a consumer that is gone is no error
                    self._run(subscription.consumer_info())
            except (Unreachable, Error) as error:
                # the first order makes the stream
                note("" if isinstance(error.__cause__, NotFoundError) else str(error))
                subscription = None
                threading.Event().wait(_RECONNECT_S)
                continue
            for message in messages:
                yield self._stored(message)

    def _stored(self, message: Msg) -> StoredMessage:
        def acknowledge() -> None:
            # one that does not arrive lets the message be delivered again, which is harmless
            with suppress(Unreachable):
                self._run(message.ack())

        def later(delay_s: float) -> None:
            with suppress(Unreachable):
                self._run(message.nak(delay=delay_s))

        try:
            chunk = parse_chunk((message.headers or {}).get(HEADER, ""), message.data)
        except ValueError:
            chunk = Chunk("", 1, 1, message.data)
        return StoredMessage(message.subject, chunk, acknowledge, later)

    def read(self, stream: str, subject: str, is_ended: Callable[[], bool]) -> Generator[bytes | None, None, None]:
        """The stored messages of a subject, from the first on, and those that are stored from now on; None whenever
        none came for a second."""
        from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy

        async def subscribe() -> JetStreamContext.PullSubscription:
            config = ConsumerConfig(
                ack_policy=AckPolicy.NONE, deliver_policy=DeliverPolicy.ALL, inactive_threshold=60, mem_storage=True
            )
            return await self._jetstream("").pull_subscribe(subject, stream=stream, config=config)

        async def fetch() -> list[Msg]:
            try:
                return await subscription.fetch(16, timeout=1)
            except TimeoutError:
                return []

        self._check_connected()
        subscription = self._run(subscribe())
        try:
            while not is_ended():
                self._check_connected()
                messages = self._run(fetch())
                if not messages:
                    yield None
                for message in messages:
                    yield message.data
        finally:
            with suppress(Unreachable):
                self._run(subscription.unsubscribe())

    def close(self) -> None:
        with suppress(Unreachable, TimeoutError):
            self._run(self._client.close())
        self._end_loop()


async def _cancel_all() -> None:
    """Cancel the other tasks of the loop."""
    left = asyncio.all_tasks() - {asyncio.current_task()}
    for task in left:
        task.cancel()
    await asyncio.gather(*left, return_exceptions=True)


def shared(server: NatsServer) -> NatsClient:
    """The client of this process for a server. Raises NatsLost."""
    with _shared_lock:
        found = _shared.get(server)
        if found is None or found.closed_by:
            found = _shared[server] = NatsClient(server)
        return found


_shared: dict[NatsServer, NatsClient] = {}
_shared_lock = threading.Lock()
