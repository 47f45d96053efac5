"""Moves datagrams, timers and events between the sockets and the core, on an asyncio loop, in batches.

1. A socket becomes readable: all waiting datagrams go to the core (`_drain`). Of three sockets, that of bulk is read in
   ticks (`bulk_ticks`), and that of strangers for a fifth of the time at most during a flood (`stranger_throttle`).
2. `_pump`: due timers, datagrams that may leave now (in runs, through segmentation offload), events to the listener,
   and one timer for the core's next deadline.
3. The kernel reports an interface change: sockets are opened and closed, and the core learns its new links.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

from udp_mesh.core.conditions import Conditions
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import Event, MessageId, PeerAddressChanged, PeerOffline, PeerOnline, PeerRestarted, Rejected
from udp_mesh.core.interfaces import RandomSource, Store
from udp_mesh.core.legacy.acks import ReceivePosition
from udp_mesh.core.logs.store import LogStore
from udp_mesh.core.settings import Settings
from udp_mesh.daemon.background import BackgroundThread
from udp_mesh.daemon.bulk_ticks import BulkTicks
from udp_mesh.daemon.link_output import LinkOutput, link_info
from udp_mesh.daemon.stranger_throttle import StrangerThrottle
from udp_mesh.links.attachments import Address, LinkConfig
from udp_mesh.links.hub import LinkHub
from udp_mesh.links.netlink import InterfaceMonitor
from udp_mesh.links.udp import Deliver, UdpLink

log = logging.getLogger(__name__)

MAX_DRAIN_DATAGRAMS = 256
"""Datagrams read per wake-up before timers and sending get their turn (3 ms of work)."""
LAST_ARRIVAL_S = 0.0003
"""A datagram this recent is taken to be the last one waiting; reading again would cost as much as receiving."""
MAX_CLOCK_GAP_S = 50e-6
"""Two clock readings within this interval count as simultaneous."""
MAX_PUMP_BYTES = 1 << 18
"""Bytes sent before the sockets get their turn again."""
INTERFACE_DEBOUNCE_S = 0.05
"""One kernel notice is followed by others (link, then addresses): one refresh handles them all."""
RECOVERY_S, RETRY_LINK_S = 0.1, 2.0
"""Delay before the next attempt after an unexpected exception, or to open a socket."""

_PATH_EVENTS = (PeerOnline, PeerOffline, PeerAddressChanged, PeerRestarted)
"""Events after which the addresses of known peers may have changed."""


class Driver:
    """Runs one node on the running loop, from `start` to `close`."""

    def __init__(
        self,
        settings: Settings,
        links: Sequence[LinkConfig],
        *,
        boot_id: bytes,
        rng: RandomSource,
        on_event: Callable[[Event], None],
        store: Store | None = None,
        log_store: LogStore | None = None,
        legacy_positions: Mapping[str, ReceivePosition] = MappingProxyType({}),
        urgent_dscp: int = 0,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._clock = self._loop.time
        self._background = BackgroundThread(self._loop, self.send_soon)
        self.node = Endpoint(
            settings,
            boot_id=boot_id,
            rng=rng,
            now=self._clock(),
            store=store,
            log_store=log_store,
            legacy_positions=legacy_positions,
            background=self._background,
        )
        self.hub = LinkHub(links, settings.port, urgent_dscp=urgent_dscp)
        self.link_failures: dict[str, str] = {}
        self.output = LinkOutput(self._loop, self.hub, self._pump)
        self.wakeups = 0
        self._on_event = on_event
        self._monitor: InterfaceMonitor | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0
        self._due = float("-inf")
        """The core's next deadline as last read; the loop may run `_pump` for other reasons than its timer."""
        self._refresh_timer: asyncio.TimerHandle | None = None
        self._interface_error = ""
        self._pump_requested = False
        self.closed = False
        self._wall_offset: float | None = None
        self._drained_at = 0.0
        self._now = 0.0
        self._link_name = ""
        self._unsorted: set[str] = set()
        """Links whose kernel does not separate peers from strangers, already logged."""
        self._bulk = BulkTicks(self._loop, self.node, self._read_bulk, self._after_drain)
        self.strangers = StrangerThrottle(
            self._loop, self._read_strangers, lambda: self.node.unauthenticated, batch=MAX_DRAIN_DATAGRAMS
        )

    # Lifecycle

    def start(self) -> None:
        """Opens the links that exist and starts. Raises OSError if the kernel cannot list its interfaces."""
        self._monitor = InterfaceMonitor()
        self._loop.add_reader(self._monitor.fileno(), self._interfaces_changed)
        self.refresh_links()
        self._pump()

    def close(self) -> None:
        """Sends goodbyes and the last datagrams, reports the last events, closes everything."""
        if self.closed:
            return
        try:
            self.node.close(self._advance_clock())
            self._transmit_all()
            self._report_events()
        finally:
            self.closed = True
            self._background.close()
            self.output.close()
            for handle in filter(None, (self._timer, self._refresh_timer)):
                handle.cancel()
            if self._monitor is not None:
                self._loop.remove_reader(self._monitor.fileno())
                self._monitor.close()
            for link in self.hub.links.values():
                self._unwatch(link)
            self.hub.close()

    # Called by the application

    @property
    def sends_now(self) -> bool:
        """Whether something leaves in this loop iteration."""
        return self._pump_requested

    def send(
        self, topic: str, payload: bytes, *, destination: str | None = None, type_name: str = ""
    ) -> MessageId | Rejected:
        """`Endpoint.send`, now; the datagrams leave in this loop iteration, or with others soon after."""
        outcome = self.node.send(
            topic, payload, destination=destination, now=self._advance_clock(), type_name=type_name
        )
        if self._pump_requested or self.closed:
            return outcome
        if not self.node.is_quiet:
            self._schedule_pump()
        elif self.node.is_due_before(self._due):
            self._reschedule()
        return outcome

    def apply(self, settings: Settings) -> list[str]:
        """`Endpoint.apply`, now. Raises ValueError for a changed name or port."""
        changes = self.node.apply(settings, self._advance_clock())
        self._schedule_pump()
        return changes

    def apply_links(self, links: Sequence[LinkConfig]) -> None:
        """Replaces the link configuration; links in both the old and the new one stay open."""
        self.hub.configs = tuple(links)
        self.refresh_links()
        self._schedule_pump()

    def conditions(self) -> Conditions:
        return self.node.conditions(self._advance_clock())

    def now(self) -> float:
        """The clock of conditions and events, in seconds."""
        return self._clock()

    def _advance_clock(self) -> float:
        """Returns the current time to pass to the core; later arrivals are not dated before it."""
        self._now = self._clock()
        return self._now

    # Links

    def refresh_links(self) -> None:
        """Brings sockets and core up to date with the kernel's interfaces."""
        self._refresh_timer = None
        open_before = list(self.hub.links.values())
        for link in open_before:
            self._unwatch(link)
        changes = self.hub.refresh()
        now = self._advance_clock()
        reopened = {link.attachment.name for link in changes.opened}
        for link in changes.gone:
            name = link.attachment.name
            self.output.link_closed(name)
            if name not in reopened:
                log.info("link-down link=%s", name)
                self.node.link_down(name, now)
        for link in changes.opened:
            log.info("link-up link=%s address=%s", link.attachment.name, link.attachment.address[0])
            self.node.link_up(link_info(link), now)
        for name, reason in changes.failed.items():
            if self.link_failures.get(name) != reason:
                log.error("link-failed link=%s reason=%s", name, reason)
        self.link_failures = changes.failed
        self._update_known_senders()
        self._watch_all()
        if changes.failed:
            self._refresh_timer = self._loop.call_later(RETRY_LINK_S, self._refresh_and_pump)

    def _watch_all(self) -> None:
        for link in self.hub.links.values():
            self.output.watch(link)
            self._loop.add_reader(link.fileno(), self._readable, link)
            self._bulk.watch(link)
            self.strangers.watch(link)

    def _update_known_senders(self) -> None:
        """Receive from the addresses of online peers at the sockets for them."""
        known = self.node.peer_addresses()
        for name, link in self.hub.links.items():
            if not link.set_peers(frozenset(known.get(name, ()))) and name not in self._unsorted:
                self._unsorted.add(name)
                log.warning("flood-protection-off link=%s peers=%d", name, len(known.get(name, ())))

    def _interfaces_changed(self) -> None:
        assert self._monitor is not None
        if self._monitor.drain():
            at = self._clock() + INTERFACE_DEBOUNCE_S
            if self._refresh_timer is not None:
                if self._refresh_timer.when() <= at:
                    # Some drivers send notices continuously: these must not postpone the refresh forever.
                    return
                self._refresh_timer.cancel()
            self._refresh_timer = self._loop.call_at(at, self._refresh_and_pump)

    def _refresh_and_pump(self) -> None:
        completed = False
        try:
            self.refresh_links()
            completed, self._interface_error = True, ""
        except OSError as error:
            if str(error) != self._interface_error:
                log.error("interfaces-unknown error=%s", error)
            self._interface_error = str(error)
        finally:
            if not completed:
                # The kernel cannot list its interfaces (out of memory), or a bug: keep the open sockets.
                self._watch_all()
                self._refresh_timer = self._loop.call_later(RETRY_LINK_S, self._refresh_and_pump)
        self._pump()

    def _unwatch(self, link: UdpLink) -> None:
        self._loop.remove_reader(link.fileno())
        self._loop.remove_writer(link.fileno())
        self._bulk.unwatch(link)
        self.strangers.unwatch(link)

    # Receive

    def _readable(self, link: UdpLink) -> None:
        self._bulk.read_ticking()
        self._drain(link, link.receive, MAX_DRAIN_DATAGRAMS)
        self._bulk.marked_arrived(link, self._now)
        self._after_drain()

    def _read_bulk(self, link: UdpLink) -> int:
        return self._drain(link, link.receive_unmarked, MAX_DRAIN_DATAGRAMS)

    def _read_strangers(self, link: UdpLink, limit: int) -> int:
        self._bulk.read_ticking()
        count = self._drain(link, link.receive_from_strangers, limit)
        self._after_drain()
        return count

    def receive_frames(self, link: str, frames: Sequence[bytes]) -> None:
        """Passes frames of a thin link to the core."""
        for frame in frames:
            self.node.receive(frame, link, ("", 0), self._advance_clock())
        self._after_drain()

    def _after_drain(self) -> None:
        if self.node.is_quiet:
            self._reschedule()
        else:
            self._pump()

    def _drain(self, link: UdpLink, receive: Callable[[Deliver, int, float], int], limit: int) -> int:
        """Passes waiting datagrams to the core, each with its arrival time; then sets `_now` to the time of reading.
        Returns their number."""
        self._drained_at = self._read_clocks()
        self._link_name = link.attachment.name
        assert self._wall_offset is not None
        count = receive(self._deliver, limit, self._drained_at + self._wall_offset - LAST_ARRIVAL_S)
        self._now = max(self._now, self._drained_at)
        return count

    def _read_clocks(self) -> float:
        """Reads the clock, and updates the offset of the wall clock, which the kernel uses for arrival timestamps.

        If this process was preempted between the readings, the previous offset is kept: a wrong one would date arrivals
        too early.
        """
        before = self._clock()
        wall = time.time()
        after = self._clock()
        if after - before < MAX_CLOCK_GAP_S or self._wall_offset is None:
            self._wall_offset = wall - after
        return after

    def _deliver(self, data: memoryview, source: Address, arrived: float) -> None:
        # Never earlier than the time already passed to the core, and never in the future: a later stamp means that the
        # wall clock was set, and then (as without a stamp) the time of reading is used.
        assert self._wall_offset is not None
        at = arrived - self._wall_offset if arrived else self._drained_at
        if at < self._now:
            at = self._now
        elif at > self._drained_at:
            # it may have arrived since the drain started
            at = min(at, self._clock())
        self._now = at
        self.node.receive(data, self._link_name, source, at)

    # Send

    def send_soon(self) -> None:
        """Something was added to the node: send it in this loop iteration."""
        self._schedule_pump()

    def _schedule_pump(self) -> None:
        if not self._pump_requested and not self.closed:
            self._pump_requested = True
            self._loop.call_soon(self._pump)

    def _pump(self) -> None:
        self._pump_requested = False
        if self.closed:
            return
        completed = False
        try:
            self._pump_once()
            completed = True
        finally:
            # The loop reports the exception; messages must keep flowing.
            if not completed and not self.closed:
                self._due = float("-inf")
                self._schedule(self._clock() + RECOVERY_S)

    def _pump_once(self) -> None:
        now = self._advance_clock()
        if self._due <= now:
            self.node.handle_timer(now)
        more = self._transmit_all()
        self._report_events()
        if more:
            self._schedule_pump()
        self.wakeups += 1
        self._reschedule()

    def _reschedule(self) -> None:
        due = self.node.next_timer()
        self._due = float("inf") if due is None else due
        if due is not None:
            self._schedule(due)

    def _schedule(self, at: float) -> None:
        """Sets the only timer; moving it costs a tenth of a needless wake-up."""
        if self._timer is not None:
            if self._timer_at == at:
                return
            self._timer.cancel()
        self._timer_at = at
        self._timer = self._loop.call_at(at, self._timer_due)

    def _timer_due(self) -> None:
        self._timer = None
        self._bulk.read_ticking()
        self._pump()

    def _transmit_all(self) -> bool:
        """Sends what may leave now, up to `MAX_PUMP_BYTES`; True if there may be more."""
        sent = 0
        while sent < MAX_PUMP_BYTES:
            batch = self.node.datagrams_to_send(self._advance_clock())
            if not batch:
                return False
            self.output.transmit_all(batch)
            sent += sum(len(datagram.data) for datagram in batch)
            if not self.node.has_datagrams:
                return False
        return True

    def _report_events(self) -> None:
        moved = False
        while (event := self.node.next_event()) is not None:
            moved = moved or isinstance(event, _PATH_EVENTS)
            self._on_event(event)
        if moved and not self.closed:
            self._update_known_senders()
