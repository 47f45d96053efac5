"""Collect a frame on a schedule: snapshot -> status -> frame -> store -> hooks and other listeners.

`FrameSampler.run` works in a thread of its own until `stop`. A round that fails (locked journal, unreadable key file)
is a `problem`, and the next one is tried at its time. Its traffic is measured at the sockets; the interval
grows while it takes more than `limit_share` of the channel.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from meshctl import event_log
from meshctl.errors import MeshctlError
from meshctl.model import Fleet, Node
from meshctl.monitor.airtime import airtime_use, next_interval_s
from meshctl.monitor.alarm_log import LoggedAlarm
from meshctl.monitor.frame import Airtime, Frame, FramePosition, frame_of
from meshctl.monitor.store import FrameStore
from meshctl.status import assess, preflight
from meshctl.status.assess import Snapshot
from meshctl.status.json_output import as_json

DEFAULT_INTERVAL_S = 5.0
# A few per cent: an operator's screen must not slow down the robots.
DEFAULT_LIMIT_SHARE = 0.03
# However expensive, the mesh is looked at this often.
LONGEST_INTERVAL_S = 300.0
# What a document that no version of a device should send may cause.
_UNEXPECTED = (ArithmeticError, AttributeError, LookupError, OSError, RuntimeError, TypeError, ValueError)
# The wall clock was set (or the computer slept), rather than being corrected by a little.
_CLOCK_STEP_S = 60.0
Positions = Callable[[], Mapping[str, FramePosition]]
FrameListener = Callable[[Frame, Sequence[LoggedAlarm]], None]


class SnapshotSource(Protocol):
    """Where frames come from."""

    def __call__(self) -> Snapshot: ...


def _no_bytes() -> Mapping[str, int]:
    return {}


def fixed_positions(fleet: Fleet) -> dict[str, FramePosition]:
    """The positions in the inventory; a robot's radios and a radio's robot stand at one place."""
    found: dict[str, FramePosition] = {}
    for robot in fleet.robots.values():
        if robot.position is not None:
            place = FramePosition(robot.position.x_m, robot.position.y_m, robot.position.z_m)
            found |= dict.fromkeys((robot.name, *robot.nodes), place)
    for node in fleet.nodes.values():
        if node.position is not None:
            found[node.name] = FramePosition(node.position.x_m, node.position.y_m, node.position.z_m)
    return found


def reported_positions(status: Mapping[str, Any]) -> dict[str, FramePosition]:
    """The positions that robots' daemons report in a status document; a robot's radios are where it is."""
    found: dict[str, FramePosition] = {}
    for robot in status.get("robots", ()):
        position = robot.get("position")
        if isinstance(position, Mapping) and all(isinstance(position.get(key), int | float) for key in ("x_m", "y_m")):
            place = FramePosition(
                position["x_m"], position["y_m"], position.get("z_m"), position.get("age_s"), "daemon"
            )
            found |= dict.fromkeys((robot["name"], *robot.get("radios", ())), place)
    return found


@dataclass(slots=True)
class FrameClock:
    """The times of frames: the wall clock, which may be set backward, made strictly increasing. While it is behind the
    last frame, time continues from there at the pace of the monotonic clock. `stepped_s` is by how much it was set
    forward so far."""

    wall: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic
    stepped_s: float = 0.0
    _last: tuple[float, float] | None = None

    def next_s(self, newest_s: float | None) -> float:
        """The time of a frame after the one at `newest_s`."""
        now_s, tick_s = self.wall(), self.monotonic()
        if self._last is not None:
            expected_s = self._last[0] + (tick_s - self._last[1])
            if now_s - expected_s > _CLOCK_STEP_S:
                self.stepped_s += now_s - expected_s
            now_s = max(now_s, expected_s)
        if newest_s is not None:
            now_s = max(now_s, newest_s + 0.001)
        self._last = (now_s, tick_s)
        return round(now_s, 3)


@dataclass(slots=True)
class FrameSampler:
    """See the module. `collect` takes one snapshot; `traffic` are the bytes so far by device; `positions` where devices
    are now; `listeners` get every frame and the alarms that began with it, in the sampler's thread."""

    fleet: Fleet
    collect: SnapshotSource
    store: FrameStore
    nodes: Sequence[Node]
    robots: Sequence[str] = ()
    interval_s: float = DEFAULT_INTERVAL_S
    limit_share: float = DEFAULT_LIMIT_SHARE
    traffic: Callable[[], Mapping[str, int]] = _no_bytes
    positions: Positions | None = None
    meters: Callable[[], Mapping[str, Mapping[str, Any]]] = dict
    listeners: list[FrameListener] = field(default_factory=list)
    clock: FrameClock = field(default_factory=FrameClock)
    topic_classes: Mapping[str, str] = field(default_factory=dict)
    on_problem: Callable[[str], None] = lambda text: None
    problem: str = ""
    """Why the last round failed; empty if it did not."""
    _end: threading.Event = field(default_factory=threading.Event, repr=False)
    _seen_bytes: Mapping[str, int] = field(default_factory=dict, repr=False)
    _last_began_s: float | None = None
    _wait_s: float = 0.0

    def run(self) -> None:
        """Sample until `stop`. A round that fails is reported, and the next one tried at its time: what one device
        says must not end the watching of all."""
        while not self._end.is_set():
            began_s = self.clock.monotonic()
            try:
                self.sample()
                self.problem = ""
            except MeshctlError as error:
                self._failed(str(error))
            except _UNEXPECTED as error:
                self._failed(f"internal error: {type(error).__name__}: {error}")
            self._end.wait(max(0.0, began_s + self._wait_s - self.clock.monotonic()))

    def _failed(self, problem: str) -> None:
        if self._end.is_set():
            # its connections may be closed already
            return
        self.problem = problem
        self._wait_s = self.interval_s
        event_log.emit(event_log.INFO, "sample failed", reason=problem)
        self.on_problem(problem)

    def stop(self) -> None:
        self._end.set()

    def sample(self) -> Frame:
        """One round. Raises MeshctlError if the fleet cannot be looked at; a full disk is `store.problem`."""
        began_s = self.clock.monotonic()
        snapshot = self.collect()
        newest = self.store.latest()
        time_s = self.clock.next_s(None if newest is None else newest.time_s)
        status = assess(snapshot, self.nodes, self.clock.wall(), self.robots)
        document = as_json(status)
        positions = fixed_positions(self.fleet) | reported_positions(document)
        if self.positions is not None:
            positions |= self.positions()
        frame = frame_of(
            document,
            time_s=time_s,
            checks=preflight(self.fleet, status),
            positions=positions,
            airtime=self._airtime(document, began_s),
            topic_classes=self.topic_classes,
            meters=self.meters(),
        )
        self.store.clock_stepped_s = self.clock.stepped_s
        began = self.store.append(frame, self.clock.wall())
        for listener in self.listeners:
            listener(frame, began)
        return frame

    def _airtime(self, document: Mapping[str, object], began_s: float) -> Airtime:
        """The cost of this round; sets the time until the next one."""
        total = self.traffic()
        sent = {device: count - self._seen_bytes.get(device, 0) for device, count in total.items()}
        self._seen_bytes = total
        use = airtime_use(sent, document)
        self._wait_s = next_interval_s(self.interval_s, use.airtime_s, self.limit_share, LONGEST_INTERVAL_S)
        # over the time until the next round: of the first one that is all that is known
        period_s = self._wait_s if self._last_began_s is None else max(began_s - self._last_began_s, 0.001)
        self._last_began_s = began_s
        return Airtime(
            bytes_per_s=use.bytes / period_s,
            share=None if use.airtime_s is None else use.airtime_s / period_s,
            limit_share=self.limit_share,
            interval_s=round(self._wait_s, 3),
        )
