"""Between the core and the local programs: requests in, messages and events out.

An event of the driver goes to the recorder, to the programs that subscribed, to whoever waits for it (a ping, a
publisher who asked for the outcome). A request is looked up in `commands.COMMANDS`. Everything runs on the loop's one
thread.
"""

from __future__ import annotations

import asyncio
import fnmatch
import logging
import os
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import replace
from pathlib import Path

from udp_mesh.client.mesh_client import Header, encode_frame
from udp_mesh.core.events import (
    Event,
    MessageDelivered,
    MessageExpired,
    MessagePeerLost,
    MessageReceived,
    Rejected,
    RejectReason,
)
from udp_mesh.core.interfaces import RandomSource
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.daemon.api import Client, RequestError
from udp_mesh.daemon.configuration import (
    BENCH_TOPIC,
    CONDITIONS_TOPIC,
    PING_TOPIC,
    PONG_TOPIC,
    RESERVED_PREFIX,
    Configuration,
    load,
)
from udp_mesh.daemon.driver import Driver
from udp_mesh.daemon.outbox import DirectoryStore, Flusher
from udp_mesh.daemon.recording import Recorder
from udp_mesh.daemon.status import TopicCount, conditions_json, event_json, event_name

log = logging.getLogger(__name__)

MAX_OUTCOMES = 65_536
"""Messages whose outcome somebody waits for: publishers that ask and never read."""
MAX_COUNTED_TOPICS = 4096
"""Topics with counts of their own: a key holder inventing names."""
MAX_PATTERNS = 1024
"""Patterns one program subscribes to: each is held against each new topic."""
TOKEN_BYTES = 8


class Service:
    """One running daemon: the driver, the configuration it runs with, the programs connected to it."""

    def __init__(
        self, configuration: Configuration, *, boot_id: bytes, rng: RandomSource, wall_clock: Callable[[], float]
    ) -> None:
        self.configuration = configuration
        self.boot_id = boot_id
        self.wall_clock = wall_clock
        self.store = DirectoryStore(
            configuration.daemon.state_directory / "outbox", configuration.daemon.outbox_disk_bytes
        )
        self._flusher = Flusher(self.store)
        self.driver = Driver(
            configuration.settings,
            configuration.links,
            boot_id=boot_id,
            rng=rng,
            on_event=self._event,
            store=self.store,
            urgent_dscp=configuration.daemon.urgent_dscp,
        )
        self.counts: dict[str, TopicCount] = {}
        self.recorder: Recorder | None = None
        self.started = self.driver.now()
        self.commands: dict[str, Callable[[Service, Client, Header, bytes], Header | Awaitable[Header] | None]] = {}
        self._subscriptions: dict[Client, list[str]] = {}
        self._watchers: set[Client] = set()
        self._routes: dict[str, list[Client]] = {}
        self._outcomes: OrderedDict[int, Client] = OrderedDict()
        self._pings: dict[bytes, asyncio.Future[float]] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._conditions_timer: asyncio.TimerHandle | None = None

    @property
    def settings(self) -> Settings:
        return self.configuration.settings

    def start(self) -> None:
        """Begins to send and receive."""
        self.driver.start()
        topics = (*self.settings.topics, self.settings.undeclared)
        if any(topic is not None and topic.outbox_on_disk for topic in topics):
            self.store.check_writable()
        self._publish_conditions()

    async def close(self) -> None:
        """Ends the driver, the waiting requests and the recording."""
        if self._conditions_timer is not None:
            self._conditions_timer.cancel()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.driver.close()
        await self.stop_recording()
        await asyncio.get_running_loop().run_in_executor(None, self.store.close)

    # Requests (the local API calls these)

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

    def client_gone(self, client: Client) -> None:
        self._subscriptions.pop(client, None)
        self._watchers.discard(client)
        self._routes.clear()

    def subscribe(self, client: Client, patterns: list[str]) -> None:
        wanted = self._subscriptions.setdefault(client, [])
        # A program that subscribes again and again wants each pattern once.
        new = [pattern for pattern in dict.fromkeys(patterns) if pattern not in wanted]
        if len(wanted) + len(new) > MAX_PATTERNS:
            raise RequestError("too-many", f"expected at most {MAX_PATTERNS} patterns of one program")
        wanted.extend(new)
        self._routes.clear()

    def unsubscribe(self, client: Client, patterns: list[str]) -> None:
        kept = [pattern for pattern in self._subscriptions.get(client, ()) if pattern not in patterns]
        self._subscriptions[client] = kept
        self._routes.clear()

    def subscribe_events(self, client: Client) -> None:
        """This program wants every event that is not a message."""
        self._watchers.add(client)

    def publish(
        self, topic: str, payload: bytes, destination: str | None, type_name: str, client: Client | None
    ) -> int | Awaitable[int]:
        """Accepts a message; later, where it must first be on disk. Raises RequestError."""
        if topic.startswith(RESERVED_PREFIX) and topic != BENCH_TOPIC:
            raise RequestError("reserved-topic", f"{topic} belongs to the daemon")
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
        if client is not None:
            self._outcomes[outcome] = client
            if len(self._outcomes) > MAX_OUTCOMES:
                self._outcomes.popitem(last=False)
        # one that is not stored never waits for those that are
        return self._flushed(outcome) if self.store.puts > stored else outcome

    async def _flushed(self, message: int) -> int:
        await self._flusher.flush()
        return message

    def topic(self, name: str) -> Topic | None:
        """How a topic travels here (None: it is refused)."""
        for topic in self.settings.topics:
            if topic.name == name:
                return topic
        return self.settings.undeclared

    async def ping(self, peer: str, timeout_s: float) -> float:
        """Seconds to the peer's daemon and back, through its core and ours. Raises RequestError."""
        token = os.urandom(TOKEN_BYTES)
        answer: asyncio.Future[float] = asyncio.get_running_loop().create_future()
        self._pings[token] = answer
        begun = self.driver.now()
        try:
            outcome = self.driver.send(PING_TOPIC, token, destination=peer)
            if isinstance(outcome, Rejected):
                raise RequestError(outcome.reason.value.replace(" ", "-"), outcome.detail)
            async with asyncio.timeout(timeout_s):
                return await answer - begun
        except TimeoutError as error:
            raise RequestError("no-answer", f"{peer} did not answer within {timeout_s:g} s") from error
        finally:
            del self._pings[token]

    # Change at run time

    def apply(self, settings: Settings) -> list[str]:
        """Runs on with these settings; returns what changed. Raises RequestError where the core refuses them."""
        try:
            changes = self.driver.apply(settings)
        except ValueError as error:
            raise RequestError("refused", str(error)) from error
        self.configuration = replace(self.configuration, settings=settings)
        for change in changes:
            log.info("settings-changed change=%s", change)
        return changes

    def reload(self) -> list[str]:
        """Reads the configuration's file again and applies it; raises ConfigurationError, RequestError."""
        return self.apply_file(load(self.configured_file()))

    def configured_file(self) -> Path:
        """The configuration's file. Raises RequestError where there is none."""
        if self.configuration.file is None:
            raise RequestError("no-file", "this daemon was started without a configuration file")
        return self.configuration.file

    def apply_file(self, fresh: Configuration) -> list[str]:
        """Applies what was read again, all or nothing; raises RequestError.

        Changes made by commands since the last reload give way to the file. What only a restart can change is said.
        """
        running = self.configuration
        notes: list[str] = []
        settings = fresh.settings
        for name in ("name", "port"):
            if getattr(settings, name) != getattr(running.settings, name):
                notes.append(f"{name}: takes effect with the next start")
                settings = replace(settings, **{name: getattr(running.settings, name)})
        if fresh.daemon != running.daemon:
            notes.append("daemon: takes effect with the next start")
        changes = self.apply(settings)
        if fresh.links != running.links:
            self.driver.apply_links(fresh.links)
            changes.append("links")
        self.configuration = replace(fresh, settings=settings, daemon=running.daemon)
        return changes + notes

    # Recording

    def check_not_recording(self) -> None:
        """Raises RequestError where a recording is running."""
        if self.recorder is not None and self.recorder.open:
            raise RequestError("already-recording", f"already recording to {self.recorder.path}")

    def start_recording(self, path: Path, payloads: bool) -> None:
        """Raises RequestError where one is running or the file cannot be made."""
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
        self.recorder.conditions(self.driver.conditions())

    async def stop_recording(self) -> Recorder | None:
        """Ends the recording; returns it when it is written whole (None: there was none)."""
        recorder, self.recorder = self.recorder, None
        if recorder is not None:
            recorder.conditions(self.driver.conditions())
            await asyncio.wrap_future(recorder.close())
        return recorder

    # Events

    def _event(self, event: Event) -> None:
        if self.recorder is not None and not _reserved(event):
            self.recorder.event(self.driver.now(), event)
        match event:
            case MessageReceived():
                self._on_message(event)
            case MessageDelivered() | MessageExpired() | MessagePeerLost():
                client = self._outcomes.get(event.message_id)
                if client is not None:
                    fields = event_json(event)
                    outcome = event_name(event).removeprefix("message-")
                    client.send_event({**fields, "event": "outcome", "outcome": outcome})
            case _:
                fields = event_json(event)
                log.info("%s %s", fields["event"], " ".join(f"{k}={v}" for k, v in fields.items() if k != "event"))
                for client in self._watchers:
                    client.send_event(fields)

    def _on_message(self, event: MessageReceived) -> None:
        topic = event.topic
        if topic.startswith(RESERVED_PREFIX):
            self._on_reserved_message(event)
            return
        count = self._count(topic)
        count.received_messages += 1
        count.received_bytes += len(event.payload)
        count.last_received = self.driver.now()
        self._distribute(
            {
                "event": "message",
                "source": event.source,
                "topic": topic,
                "type": event.type_name,
                "priority": event.priority,
                "broadcast": event.broadcast,
            },
            event.payload,
        )

    def _on_reserved_message(self, event: MessageReceived) -> None:
        if event.topic == PING_TOPIC and len(event.payload) == TOKEN_BYTES:
            self.driver.send(PONG_TOPIC, event.payload, destination=event.source)
        elif event.topic == PONG_TOPIC:
            waiting = self._pings.get(event.payload)
            if waiting is not None and not waiting.done():
                waiting.set_result(self.driver.now())

    def _distribute(self, header: Header, payload: bytes) -> None:
        topic = str(header["topic"])
        clients = self._routes.get(topic)
        if clients is None:
            clients = [
                client
                for client, patterns in self._subscriptions.items()
                if any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)
            ]
            if len(self._routes) >= MAX_COUNTED_TOPICS:
                self._routes.clear()
            self._routes[topic] = clients
        if clients:
            frame = encode_frame(header, payload)
            for client in clients:
                client.send_encoded(frame)

    def _publish_conditions(self) -> None:
        """Once per period: the conditions as a topic for local programs, and into the recording."""
        period_s = self.configuration.daemon.conditions_period_s
        self._conditions_timer = asyncio.get_running_loop().call_later(period_s, self._publish_conditions)
        if self.store.needs_flush:
            # What a peer left behind when it went out of reach: nobody waits for it.
            self._spawn(self._flusher.flush())
        wanted = any(CONDITIONS_TOPIC in patterns for patterns in self._subscriptions.values())
        if not wanted and self.recorder is None:
            return
        conditions = self.driver.conditions()
        if self.recorder is not None:
            self.recorder.conditions(conditions)
        if wanted:
            header: Header = {
                "event": "conditions",
                "source": self.settings.name,
                "topic": CONDITIONS_TOPIC,
                "conditions": conditions_json(conditions),
            }
            for client, patterns in self._subscriptions.items():
                if CONDITIONS_TOPIC in patterns:
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
"""The `code` of a refused `publish`."""
