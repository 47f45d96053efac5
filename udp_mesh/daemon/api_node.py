"""The transport inside your own asyncio program, without a daemon.

    settings = Settings(name="ugv1", keys=(Key.parse(text),), topics=(Topic("status", priority=0),))
    async with Node(settings) as node:
        await node.send("status", b"ready", to="base")
        async for message in node.messages():
            ...

A node opens its links on entry and sends a goodbye on exit. Received messages and events wait in bounded queues until
they are read; `deliver` waits for the outcome of a reliable message.
"""

from __future__ import annotations

import asyncio
import os
import random
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace
from ipaddress import ip_address
from types import TracebackType

from udp_mesh.core.conditions import Conditions
from udp_mesh.core.events import (
    Event,
    MessageDelivered,
    MessageExpired,
    MessageId,
    MessagePeerLost,
    MessageReceived,
    Receipt,
    Rejected,
    RejectReason,
)
from udp_mesh.core.setting_checks import check_items, check_type
from udp_mesh.core.settings import Settings
from udp_mesh.daemon.directory_lock import DirectoryLock
from udp_mesh.daemon.driver import Driver
from udp_mesh.daemon.interface import POSITION_TOPIC
from udp_mesh.daemon.outbox import DirectoryStore
from udp_mesh.daemon.unread import RETRY_S, Reading, Unread, UnreadMessages
from udp_mesh.links.attachments import EVERY_INTERFACE, LinkConfig
from udp_mesh.wire.limits import BOOT_ID_BYTES

Outcome = MessageDelivered | MessageExpired | MessagePeerLost


class SendRefusedError(Exception):
    """The core refused a message; `reason` says why."""

    def __init__(self, rejected: Rejected) -> None:
        super().__init__(f"{rejected.reason.value}: {rejected.detail}")
        self.reason: RejectReason = rejected.reason


class Node:
    """One node in this process, running inside its `async with` block."""

    def __init__(
        self,
        settings: Settings,
        *,
        links: Sequence[LinkConfig] = EVERY_INTERFACE,
        store: DirectoryStore | None = None,
        urgent_dscp: int = 46,
    ) -> None:
        check_type(settings, Settings, "settings")
        check_items(links, LinkConfig, "links")
        for link in links:
            _check_link(link)
        check_type(urgent_dscp, int, "urgent_dscp")
        if not 0 <= urgent_dscp <= 63:
            raise ValueError(f"urgent_dscp: expected 0 to 63, found {urgent_dscp}")
        _check_addresses(settings)
        self._settings = replace(settings, confirms=True)
        self._links = tuple(links)
        self._store = store
        self._urgent_dscp = urgent_dscp
        self._store_lock: DirectoryLock | None = None
        self._driver: Driver | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._messages = UnreadMessages(self._confirm, self._postpone)
        self._events: Unread[Event] = Unread()
        self._outcomes: dict[tuple[MessageId, str], asyncio.Future[Outcome]] = {}

    async def __aenter__(self) -> Node:
        """Opens the links. Raises OSError if the kernel cannot list its interfaces, or another node or process uses the
        directory of the store, and RuntimeError in a node that is running already."""
        if self._driver is not None and not self._driver.closed:
            raise RuntimeError("the node is running already: use another `Node` for a second one")
        self._loop = asyncio.get_running_loop()
        if self._driver is not None:
            # The run before was in another loop, perhaps. Its senders send again what was not read then.
            self._messages = UnreadMessages(self._confirm, self._postpone)
            self._events, self._outcomes = Unread(), {}
        self._store_lock = None if self._store is None else self._store.lock()
        try:
            self._driver = Driver(
                self._settings,
                self._links,
                boot_id=os.urandom(BOOT_ID_BYTES),
                rng=random.SystemRandom(),
                on_event=self._event,
                store=self._store,
                urgent_dscp=self._urgent_dscp,
            )
            self._driver.start()
        except BaseException:
            # without an `async with` block, nothing else closes its sockets and timers
            self._close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()
        for future in self._outcomes.values():
            if not future.done():
                # Messages that wait on disk have no outcome yet.
                future.set_exception(RuntimeError("the node was closed before the outcome of the message was known"))
        self._messages.close()
        self._events.close()

    def _close(self) -> None:
        try:
            if self._driver is not None:
                self._driver.close()
        finally:
            if self._store_lock is not None:
                self._store_lock.release()

    @property
    def messages_dropped(self) -> int:
        """Messages of this run that were dropped because the program did not read them: beyond 65,536 messages or
        256 MiB, the oldest is. What its sender keeps on disk comes again later instead."""
        return self._messages.dropped

    @property
    def driver(self) -> Driver:
        """The running driver. Raises RuntimeError outside of `async with`."""
        if self._driver is None:
            raise RuntimeError("the node is not running: use it inside `async with`")
        return self._driver

    async def send(self, topic: str, payload: bytes, *, to: str | None = None, type_name: str = "") -> MessageId:
        """Accepts a message for one peer, for the topic's destinations, or for all. Raises SendRefusedError, and
        TypeError for a payload that is not bytes. A buffer that may change, such as a bytearray, is copied."""
        outcome = self._accept(topic, payload, to, type_name)
        if isinstance(outcome, Rejected):
            raise SendRefusedError(outcome)
        if self.driver.sends_now:
            # Yield, so that datagrams leave even if the caller sends in a loop.
            await asyncio.sleep(0)
        return outcome

    async def deliver(self, topic: str, payload: bytes, *, to: str, type_name: str = "") -> Outcome:
        """Sends a message of a reliable topic to one peer and waits for its outcome. Raises SendRefusedError,
        ValueError for a best-effort topic, and RuntimeError if the node is closed before the outcome is known."""
        found = self.driver.node.topic(topic)
        if found is not None and not found.reliable:
            raise ValueError(f"topic {topic} is best effort and reports no outcomes: use `send`, or make it reliable")
        outcome = self._accept(topic, payload, to, type_name)
        if isinstance(outcome, Rejected):
            raise SendRefusedError(outcome)
        future: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        outcomes = self._outcomes
        outcomes[outcome, to] = future
        try:
            return await future
        finally:
            del outcomes[outcome, to]

    def _accept(self, topic: str, payload: bytes, to: str | None, type_name: str) -> MessageId | Rejected:
        self._check_loop()
        check_type(topic, str, "topic")
        if to is not None:
            check_type(to, str, "to")
        check_type(type_name, str, "type_name")
        return self.driver.send(topic, _unchanging(payload), destination=to, type_name=type_name)

    def messages(self) -> AsyncIterator[MessageReceived]:
        """Messages in order of completion, until the node is closed. A message counts as delivered once it is
        yielded."""
        return Reading(self._messages, self._check_loop)

    def events(self) -> AsyncIterator[Event]:
        """All other events: peers, outcomes, conflicts, starvation."""
        return Reading(self._events, self._check_loop)

    def _confirm(self, receipt: Receipt) -> None:
        self.driver.node.confirm(receipt)
        self.driver.send_soon()

    def _postpone(self, receipt: Receipt) -> None:
        asyncio.get_running_loop().call_later(RETRY_S, self._request_again, self.driver, receipt)

    def _request_again(self, driver: Driver, receipt: Receipt) -> None:
        if not driver.closed:
            driver.node.request_again(receipt)
            driver.send_soon()

    def _check_loop(self) -> None:
        """A node is not safe for threads: another one would change it while it sends, and not wake it."""
        if self._driver is not None and asyncio.get_running_loop() is not self._loop:
            raise RuntimeError(
                "the node runs in another event loop: call it there, for example with asyncio.run_coroutine_threadsafe"
            )

    def apply(self, settings: Settings) -> list[str]:
        """Changes topics, window, rates, limits, keys, neighbors. Drops no message. Raises ValueError."""
        check_type(settings, Settings, "settings")
        _check_addresses(settings)
        settings = replace(settings, confirms=True)
        changes = self.driver.apply(settings)
        self._settings = settings
        return changes

    def conditions(self) -> Conditions:
        return self.driver.conditions()

    def _event(self, event: Event) -> None:
        if isinstance(event, MessageReceived):
            if event.topic == POSITION_TOPIC:
                # between daemons
                return
            self._messages.add(event)
            return
        if isinstance(event, Outcome):
            future = self._outcomes.get((event.message_id, event.peer))
            if future is not None and not future.done():
                future.set_result(event)
        self._events.add(event)


def _check_addresses(settings: Settings) -> None:
    """Raises ValueError for a neighbor whose address is no IP address: names are not looked up."""
    for neighbor in settings.neighbours:
        try:
            ip_address(neighbor.address[0])
        except ValueError:
            raise ValueError(f"neighbor: expected an IP address, found {neighbor.address[0]!r}") from None


def _check_link(link: LinkConfig) -> None:
    """Raises TypeError or ValueError for a link that names neither or both of its interface and address, or whose
    address is none."""
    for name, kind in (("interface", str), ("address", str), ("mtu", int)):
        value = getattr(link, name)
        if value is not None:
            check_type(value, kind, f"link {name}")
    if (link.interface is None) == (link.address is None):
        raise ValueError(f"link: expected either interface or address, found {'both' if link.address else 'neither'}")
    if link.address is not None:
        try:
            address = ip_address(link.address)
        except ValueError:
            raise ValueError(f"link: expected an IP address, found {link.address!r}") from None
        if address.version == 6 and address.is_link_local:
            raise ValueError(
                f"link: expected an address that is not link-local, found {link.address}: set `interface` instead"
            )


def _unchanging(payload: object) -> bytes:
    """The payload as bytes, which no program can change while it waits. Raises TypeError for anything else."""
    if isinstance(payload, bytes):
        return payload
    if isinstance(payload, str):
        raise TypeError("payload: expected bytes, found str; encode it first, for example with .encode()")
    try:
        return bytes(memoryview(payload))  # type: ignore[arg-type]
    except TypeError:
        raise TypeError(f"payload: expected bytes, found {type(payload).__name__}") from None
