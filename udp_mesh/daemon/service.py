"""Connects the core and the local clients: requests in, messages and events out.

An event of the driver goes to the recorder, to the subscribed clients, and to the request that waits for it (a ping, a
publisher that asked for the outcome). Requests are looked up in `commands.COMMANDS`. Everything runs on the loop's
single thread.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import replace
from pathlib import Path

from udp_mesh.client.mesh_client import Header
from udp_mesh.core.events import (
    Event,
    MessageDelivered,
    MessageExpired,
    MessagePeerLost,
    MessageReceived,
    Receipt,
    Rejected,
    RejectReason,
)
from udp_mesh.core.interfaces import RandomSource
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.core.subscriptions.messages import Subscription
from udp_mesh.daemon.api import Client, RequestError
from udp_mesh.daemon.configuration import Configuration, load
from udp_mesh.daemon.driver import Driver
from udp_mesh.daemon.event_log import EventLog
from udp_mesh.daemon.inbox import Inbox
from udp_mesh.daemon.interface import BENCH_TOPIC, CONDITIONS_TOPIC, RESERVED_PREFIX
from udp_mesh.daemon.latencies import Latencies
from udp_mesh.daemon.legacy_positions import LegacyPositions
from udp_mesh.daemon.log_store import Put, SqliteLogStore
from udp_mesh.daemon.outbox import DirectoryStore, Flusher
from udp_mesh.daemon.outcomes import AwaitedOutcomes, Publisher
from udp_mesh.daemon.pings import Pings
from udp_mesh.daemon.position_exchange import PositionExchange
from udp_mesh.daemon.radio_paths import RadioReport, with_radio
from udp_mesh.daemon.recording import Recorder
from udp_mesh.daemon.status import TopicCount, conditions_json, event_json
from udp_mesh.daemon.subscriptions import Subscriptions
from udp_mesh.daemon.thin_ports import ThinPorts

log = logging.getLogger(__name__)

MAX_COUNTED_TOPICS = 4096
"""Topics with counters of their own; a holder of the key could invent names without bound."""
AFTER_RESTART = "takes effect after a restart"
"""In the answer to `reload`. Scripts look for it, such as meshctl's `robots/scripts/switch.sh`."""


class Service:
    """One running daemon: the driver, its current configuration, the connected clients."""

    def __init__(
        self, configuration: Configuration, *, boot_id: bytes, rng: RandomSource, wall_clock: Callable[[], float]
    ) -> None:
        self.configuration = configuration
        self.boot_id = boot_id
        self.wall_clock = wall_clock
        state, disk_bytes = configuration.daemon.state_directory, configuration.daemon.outbox_disk_bytes
        self.store = DirectoryStore(state / "outbox", disk_bytes)
        self._flusher = Flusher(self.store)
        self.log_store = SqliteLogStore(state / "logs" / "items.db", wall_clock)
        self._legacy = LegacyPositions(state / "legacy-positions.json")
        self.latencies = Latencies(self._priority)
        self.driver = Driver(
            configuration.settings,
            configuration.links,
            boot_id=boot_id,
            rng=rng,
            on_event=self.latencies.watching(self._event),
            store=self.store,
            log_store=self.log_store,
            legacy_positions=self._legacy.saved,
            urgent_dscp=configuration.daemon.urgent_dscp,
        )
        self.thin_ports = ThinPorts(self.driver, configuration.thin_ports)
        self.log_store.on_done = self.driver.send_soon
        self.inbox = Inbox(DirectoryStore(state / "inbox", disk_bytes), self._confirm, self._request_again)
        self.inbox.load()
        self.counts: dict[str, TopicCount] = {}
        self.positions = PositionExchange(
            self.driver, configuration.settings.name, configuration.position, lambda: self.recorder
        )
        self.radio: RadioReport | None = None
        self.recorder: Recorder | None = None
        self.started = self.driver.now()
        self.commands: dict[str, Callable[[Service, Client, Header, bytes], Header | Awaitable[Header] | None]] = {}
        self.subscriptions = Subscriptions(self.inbox, self._spawn, self._priority, self._announce_subscriptions)
        self._watchers: set[Client] = set()
        self._outcomes = AwaitedOutcomes()
        self._event_log = EventLog(self.driver.now)
        self.pings = Pings(self.driver)
        self._tasks: set[asyncio.Task[None]] = set()
        self._conditions_timer: asyncio.TimerHandle | None = None

    @property
    def settings(self) -> Settings:
        return self.configuration.settings

    def start(self) -> None:
        """Starts sending and receiving."""
        self.driver.start()
        self.thin_ports.start()
        topics = (*self.settings.topics, self.settings.undeclared)
        if any(topic is not None and topic.outbox_on_disk for topic in topics):
            self.store.check_writable()
        self._publish_conditions()
        self.subscriptions.announce()
        self.positions.start()

    async def close(self) -> None:
        """Stops the driver, cancels waiting requests and ends the recording."""
        if self._conditions_timer is not None:
            self._conditions_timer.cancel()
        self.positions.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.inbox.confirm_stored()
        self.driver.close()
        self.thin_ports.close()
        await self._legacy.save(self.driver.node.legacy_positions())
        await self.stop_recording()
        for close in (self.store.close, self.inbox.close, self.log_store.close):
            await asyncio.get_running_loop().run_in_executor(None, close)

    # Requests (called by the local API)

    def request(self, client: Client, header: Header, payload: bytes) -> None:
        op = header.get("op")
        command = self.commands.get(op) if isinstance(op, str) else None
        if command is None:
            raise RequestError("unknown-op", f"expected one of {', '.join(sorted(self.commands))}, found {op!r}")
        answer = command(self, client, header, payload)
        if answer is None:
            return
        if isinstance(answer, dict):
            client.reply(header.get("id"), **answer)
            return
        self._spawn(self._answer_later(client, header, answer))

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer_later(self, client: Client, header: Header, answer: Awaitable[Header]) -> None:
        try:
            client.reply(header.get("id"), **await answer)
        except RequestError as error:
            client.refuse(header.get("id"), error.code, str(error))

    def client_read(self) -> None:
        self.inbox.take_read()

    def client_gone(self, client: Client) -> None:
        self.subscriptions.remove_client(client)
        self._outcomes.remove_client(client)
        self._watchers.discard(client)

    def subscribe_events(self, client: Client) -> None:
        """Sends all events except messages to this client."""
        self._watchers.add(client)

    def publish(
        self, topic: str, payload: bytes, destination: str | None, type_name: str, publisher: Publisher | None
    ) -> int | Awaitable[int]:
        """Accepts a message; returns an awaitable if it must be on disk first. Raises RequestError."""
        if topic.startswith(RESERVED_PREFIX) and topic != BENCH_TOPIC:
            raise RequestError("reserved-topic", f"topic {topic} is reserved for the daemon")
        stored = self.store.puts
        outcome = self.driver.send(topic, payload, destination=destination, type_name=type_name)
        if isinstance(outcome, Rejected):
            raise RequestError(outcome.reason.value.replace(" ", "-"), f"{outcome.reason.value}: {outcome.detail}")
        settings = self.topic(topic)
        count = self._count(topic)
        count.sent_messages += 1
        count.sent_bytes += len(payload)
        count.last_sent = self.driver.now()
        if self.recorder is not None and settings is not None:
            self.recorder.sent(
                self.driver.now(),
                message=outcome,
                topic=topic,
                priority=settings.priority,
                size=len(payload),
                destination=destination,
                reliable=settings.reliable,
            )
        if publisher is not None and settings is not None and settings.reliable:
            self._outcomes.add(outcome, publisher, destination=destination)
        if settings is not None and settings.log is not None:
            put = self.log_store.last_put
            assert put is not None
            return self._logged(outcome, put)
        return self._flushed(outcome) if self.store.puts > stored else outcome

    async def _flushed(self, message: int) -> int:
        await self._flusher.flush()
        return message

    async def _logged(self, message: int, put: Put) -> int:
        """The item is on disk. Raises RequestError if the disk refused it."""
        await put.stored.wait()
        if put.problem is not None:
            raise RequestError("log-not-stored", f"the log is not on disk: {put.problem}")
        return message

    def topic(self, name: str) -> Topic | None:
        """See `Endpoint.topic`."""
        return self.driver.node.topic(name)

    # Runtime changes

    def apply(self, settings: Settings) -> list[str]:
        """Applies settings and returns the changes. Raises RequestError if the core refuses them."""
        try:
            changes = self.driver.apply(settings)
        except ValueError as error:
            raise RequestError("refused", str(error)) from error
        self.configuration = replace(self.configuration, settings=settings)
        for change in changes:
            log.info("settings-changed change=%s", change)
        return changes

    def reload(self) -> list[str]:
        """Reads the configuration file again and applies it. Raises ConfigurationError, RequestError."""
        return self.apply_file(load(self.configured_file()))

    def configured_file(self) -> Path:
        """The configuration file. Raises RequestError if there is none."""
        if self.configuration.file is None:
            raise RequestError("no-file", "this daemon was started without a configuration file")
        return self.configuration.file

    def apply_file(self, fresh: Configuration) -> list[str]:
        """Applies a reloaded configuration, all or nothing. Raises RequestError.

        It overrides changes made by requests since the last reload. The result also lists what requires a restart.
        """
        running = self.configuration
        notes: list[str] = []
        settings = fresh.settings
        for name in ("name", "port"):
            if getattr(settings, name) != getattr(running.settings, name):
                notes.append(f"{name}: {AFTER_RESTART}")
                settings = replace(settings, **{name: getattr(running.settings, name)})
        if fresh.daemon != running.daemon:
            notes.append(f"daemon: {AFTER_RESTART}")
        changes = self.apply(settings)
        if fresh.links != running.links:
            self.driver.apply_links(fresh.links)
            changes.append("links")
        self.thin_ports.apply(fresh.thin_ports)
        if fresh.position != running.position:
            self.positions.set_fixed(fresh.position)
            changes.append("position")
        self.configuration = replace(fresh, settings=settings, daemon=running.daemon)
        return changes + notes

    # Recording

    def check_not_recording(self) -> None:
        """Raises RequestError if a recording is running."""
        if self.recorder is not None and self.recorder.open:
            raise RequestError("already-recording", f"already recording to {self.recorder.path}")

    def start_recording(self, path: Path, payloads: bool) -> None:
        """Raises RequestError if a recording is running or the file cannot be created."""
        self.check_not_recording()
        try:
            self.recorder = Recorder(
                path,
                node=self.settings.name,
                boot_id=self.boot_id,
                wall_s=self.wall_clock(),
                now=self.driver.now(),
                limit_bytes=self.configuration.daemon.record_bytes,
                payloads=payloads,
            )
        except OSError as error:
            raise RequestError("cannot-record", f"{path}: {error.strerror}") from error
        self._record_totals(self.recorder)

    async def stop_recording(self) -> Recorder | None:
        """Ends the recording and returns it once it is completely written (None: there was none)."""
        recorder, self.recorder = self.recorder, None
        if recorder is not None:
            self._record_totals(recorder)
            await asyncio.wrap_future(recorder.close())
        return recorder

    def _record_totals(self, recorder: Recorder) -> None:
        """Records the conditions, and what only the first and the last of them contain."""
        node = self.driver.node
        conditions = self.driver.conditions()
        recorder.conditions(conditions, node.versions(), node.logs(), node.thin_conditions(conditions.now), self.radio)

    def _announce_subscriptions(self, read: list[Subscription]) -> None:
        self.driver.node.selective.set_subscriptions(read, self.driver.now())
        self.driver.send_soon()

    # Events

    def _event(self, event: Event) -> None:
        if self.recorder is not None and not _reserved(event):
            self.recorder.event(self.driver.now(), event)
        match event:
            case MessageReceived():
                self._on_message(event)
            case MessageDelivered() | MessageExpired() | MessagePeerLost():
                publisher = self._outcomes.publisher(event.message_id)
                if publisher is not None:
                    publisher.report(event)
            case _:
                fields = event_json(event)
                self._event_log.write(fields)
                for client in self._watchers:
                    client.send_event(fields)

    def _on_message(self, event: MessageReceived) -> None:
        topic = event.topic
        if topic.startswith(RESERVED_PREFIX):
            if not self.pings.on_message(event):
                self.positions.on_reserved_message(event)
            return
        count = self._count(topic)
        count.received_messages += 1
        count.received_bytes += len(event.payload)
        count.last_received = self.driver.now()
        self.subscriptions.distribute(event)

    # Messages held until a program takes them

    def _confirm(self, receipt: Receipt) -> None:
        self.driver.node.confirm(receipt)
        self.driver.send_soon()

    def _request_again(self, receipt: Receipt) -> None:
        self.driver.node.request_again(receipt)
        self.driver.send_soon()

    def acknowledge(self, client: Client, receipts: list[int]) -> int:
        """A client took these messages. Returns how many of them were waiting for that."""
        return sum([self.inbox.acknowledge(client, receipt) for receipt in receipts])

    def _priority(self, topic: str) -> int:
        settings = self.topic(topic)
        return 0 if settings is None else settings.priority

    def _publish_conditions(self) -> None:
        """Once per period: sends the conditions to subscribed clients and to the recording."""
        period_s = self.configuration.daemon.conditions_period_s
        self._conditions_timer = asyncio.get_running_loop().call_later(period_s, self._publish_conditions)
        if self.store.needs_flush:
            # Messages stored because a peer went offline; no publisher waits for them.
            self._spawn(self._flusher.flush())
        if not self._legacy.is_saving:
            self._spawn(self._legacy.save(self.driver.node.legacy_positions()))
        self.inbox.take_read()
        self.subscriptions.pass_on_held()
        clients = list(self.subscriptions.subscribed_literally(CONDITIONS_TOPIC))
        if not clients and self.recorder is None:
            return
        conditions = self.driver.conditions()
        if self.recorder is not None:
            self.recorder.conditions(conditions, (), (), self.driver.node.thin_conditions(conditions.now), self.radio)
        if clients:
            header: Header = {
                "event": "conditions",
                "source": self.settings.name,
                "topic": CONDITIONS_TOPIC,
                "conditions": with_radio(conditions_json(conditions), self.radio, conditions.now),
            }
            for client in clients:
                client.send_event(header)

    def _count(self, topic: str) -> TopicCount:
        count = self.counts.get(topic)
        if count is None:
            count = TopicCount()
            if len(self.counts) < MAX_COUNTED_TOPICS:
                self.counts[topic] = count
        return count


def _reserved(event: Event) -> bool:
    return isinstance(event, MessageReceived) and event.topic.startswith(RESERVED_PREFIX)


REJECTION_CODES = tuple(reason.value.replace(" ", "-") for reason in RejectReason)
"""Values of `code` for a refused `publish`."""
