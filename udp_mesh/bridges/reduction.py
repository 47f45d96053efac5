"""Sends less than ROS publishes: a topic's rate, image quality, cloud density. No ROS, no clock.

Per topic, `Reduction` states what is allowed. A message passes the throttle (`rate_hz`), then its content is reduced:
images become JPEG (`images`), point clouds lose points and fields (`clouds`). With `adapt`, `DetailController` chooses
between the coarsest and the finest settings from how long the transport took for earlier messages. Types of both
versions of ROS are read through `message_codec`.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from typing import Any, Deque, Dict, Mapping, NamedTuple, Optional, Tuple

from udp_mesh.bridges.message_codec import CodecError, Numbers, decode, encode
from udp_mesh.bridges.message_definition import MessageDefinition
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.mixed_team import ros1_type, ros2_type
from udp_mesh.bridges.names import Route
from udp_mesh.bridges.ros2.quality import parse_quality, quality_text
from udp_mesh.bridges.types import TypeKey

IMAGE, JPEG, CLOUD = "sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/PointCloud2"
TARGET_SHARE = 0.5
"""Of a period: how long a message should take. The rest is for more urgent messages and for lost packets."""
DEADBAND = 0.35
"""Natural logarithm of latency / target without a reaction: between 0.7 and 1.4 times the target."""
GAIN = 0.3
"""Detail per unit of that logarithm. Below 1 / ln(size at detail 1 / size at detail 0), the detail approaches its value
from one side: for a range of sizes of 1 : 20."""
MAX_INCREASE = 0.05
"""Of detail, per message."""
LATE_DECREASES = (0.0, 0.1, 0.3, 0.6)
"""Of detail, for the first, second, third and each further message in a row that did not leave before the next one:
a pause of a second costs little, a link that carries nothing takes the detail down within ten messages or so."""
LATENCIES = 5
"""Of which the median counts: two messages that lost packets change nothing."""


class ReductionError(ValueError):
    """This message cannot be reduced."""


class JpegOptions(NamedTuple):
    """JPEG `quality` (1 to 95), with `adapt` down to `min_quality`; width and height are multiplied by `scale`."""

    quality: int = 60
    min_quality: int = 10
    scale: float = 1.0


class Reduction(NamedTuple):
    """How to reduce a topic. `voxel_m`: one point per cube of this edge, with `adapt` up to `max_voxel_m`;
    `fields`: those of a cloud's points to keep, empty for all. `adapt` needs `rate_hz`."""

    rate_hz: Optional[float] = None
    encode: Optional[JpegOptions] = None
    voxel_m: Optional[float] = None
    max_voxel_m: Optional[float] = None
    fields: Tuple[str, ...] = ()
    adapt: bool = False

    @property
    def changes_content(self) -> bool:
        return self.encode is not None or self.voxel_m is not None or bool(self.fields)


class Throttle:
    """Passes at most `rate_hz` messages a second, evenly: a source at 30 Hz becomes one at 1 Hz."""

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._due_s = -math.inf

    def passes(self, now: float) -> bool:
        """`now` in monotonic seconds."""
        if now < self._due_s:
            return False
        # in step with the period, unless the source paused
        self._due_s = max(self._due_s + self._period_s, now)
        if self._due_s <= now:
            self._due_s = now + self._period_s
        return True


class DetailController:
    """How detailed messages may be, 0 to 1, so that one takes about TARGET_SHARE of a period to its destination.

    The latency is the budget that the transport gives the topic: it contains the link's rate, the more urgent messages
    that go first, and repetitions. It grows with the message's size, which grows about exponentially with the detail;
    so detail is moved in proportion to the logarithm of latency / target: an integral controller that settles. Slowly
    upwards, fast downwards, not at all near the target.

    An outcome counts only if its message was published after the previous outcome that counted. So messages that one
    pause of the link or of a host delayed together count once, and after a change of detail nothing counts that was
    made before it.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._target_s = TARGET_SHARE * period_s
        self._latencies: Deque[float] = deque(maxlen=LATENCIES)
        self._counted_s = -math.inf
        self._late_in_a_row = 0
        self.detail = 1.0

    def on_delivered(self, now: float, latency_s: float, detail_in_use: float = 1.0) -> None:
        """A message arrived, so long after it was published. `detail_in_use` may be less than ours, for the sake of
        another destination: then the latency says nothing about ours. `now` in monotonic seconds."""
        self.detail = min(self.detail, detail_in_use + MAX_INCREASE)
        if now - latency_s < self._counted_s:
            return
        self._counted_s = now
        self._late_in_a_row = 0
        self._latencies.append(max(latency_s, 1e-6))
        if len(self._latencies) < LATENCIES:
            return
        error = math.log(sorted(self._latencies)[LATENCIES // 2] / self._target_s)
        if abs(error) > DEADBAND:
            self._move(min(-GAIN * error, MAX_INCREASE))

    def on_late(self, now: float) -> None:
        """A message was superseded by the next one, or its deadline passed, before it left."""
        # it is a period old; half a period of tolerance for uneven ones
        if now - self._counted_s < 1.5 * self._period_s:
            return
        self._counted_s = now
        self._move(-LATE_DECREASES[min(self._late_in_a_row, len(LATE_DECREASES) - 1)])
        self._late_in_a_row += 1

    def _move(self, change: float) -> None:
        moved = min(1.0, max(0.0, self.detail + change))
        if change < 0 and moved != self.detail:
            # the next outcomes are those of the smaller messages
            self._latencies.clear()
        self.detail = moved


def jpeg_quality(options: JpegOptions, detail: float) -> int:
    least = min(options.min_quality, options.quality)
    return round(least + detail * (options.quality - least))


def voxel_edge_m(reduction: Reduction, detail: float) -> Optional[float]:
    """Between `voxel_m` and `max_voxel_m` in equal ratios, since the number of points falls with a power of it."""
    if reduction.voxel_m is None:
        return None
    most = max(reduction.max_voxel_m or reduction.voxel_m, reduction.voxel_m)
    return float(most * (reduction.voxel_m / most) ** detail)


class Reduced(NamedTuple):
    """A message to send in place of the published one; `definition` as in ROS 1, "" in ROS 2."""

    key: TypeKey
    definition: str
    payload: bytes


class Reducer:
    """The reductions of one bridge, by mesh topic. May be called from several threads."""

    def __init__(self, reductions: Mapping[str, Reduction], ros_version: int) -> None:
        self._reductions = dict(reductions)
        self._ros_version = ros_version
        self._throttles: Dict[Route, Throttle] = {}
        self._periods_s = {
            topic: 1.0 / reduction.rate_hz
            for topic, reduction in self._reductions.items()
            if reduction.adapt and reduction.rate_hz
        }
        self._controllers: Dict[str, Dict[str, DetailController]] = {topic: {} for topic in self._periods_s}
        """By topic and destination: the slowest one decides."""
        self._lock = threading.Lock()

    def adapts(self, topic: str) -> bool:
        """Whether the outcomes of this topic's messages have to be passed to `on_outcome`."""
        return topic in self._periods_s

    def detail(self, topic: str) -> float:
        """1.0 for a topic that is not adapted."""
        with self._lock:
            return self._detail(topic)

    def _detail(self, topic: str) -> float:
        return min((each.detail for each in self._controllers.get(topic, {}).values()), default=1.0)

    def on_outcome(self, topic: str, peer: str, outcome: str, latency_s: Optional[float], now: float) -> None:
        """The outcome of a message at one destination, as the daemon's event names it; `now` in monotonic seconds."""
        with self._lock:
            if topic not in self._periods_s:
                return
            controllers, in_use = self._controllers[topic], self._detail(topic)
            if outcome == "peer-lost":
                controllers.pop(peer, None)
                return
            if peer not in controllers:
                controllers[peer] = DetailController(self._periods_s[topic])
            if outcome == "expired":
                controllers[peer].on_late(now)
            elif latency_s is not None:
                controllers[peer].on_delivered(now, latency_s, in_use)

    def reduce(
        self, route: Route, key: TypeKey, definition: str, payload: bytes, now: float, *, latched: bool = False
    ) -> Optional[Reduced]:
        """The message to send; None if the throttle holds it back. A latched message always passes it, because no other
        may follow. Raises ReductionError."""
        reduction = self._reductions.get(route.topic)
        if reduction is None:
            return Reduced(key, definition, payload)
        if reduction.rate_hz is not None and not latched:
            with self._lock:
                throttle = self._throttles.get(route)
                if throttle is None:
                    throttle = self._throttles[route] = Throttle(reduction.rate_hz)
                if not throttle.passes(now):
                    return None
        if not reduction.changes_content:
            return Reduced(key, definition, payload)
        return self._with_less_content(reduction, key, definition, payload, self.detail(route.topic))

    def _with_less_content(
        self, reduction: Reduction, key: TypeKey, definition: str, payload: bytes, detail: float
    ) -> Reduced:
        name = ros1_type(key.name)
        if name in (IMAGE, JPEG) and reduction.encode is not None:
            message = self._decoded(key, payload)
            return self._encoded(TYPES[JPEG], _jpeg(message, reduction.encode, detail, is_raw=name == IMAGE), key)
        if name == CLOUD and (reduction.voxel_m is not None or reduction.fields):
            from udp_mesh.bridges.clouds import CloudError, reduced_cloud

            message = self._decoded(key, payload)
            try:
                message = reduced_cloud(message, voxel_edge_m(reduction, detail), reduction.fields)
            except CloudError as error:
                raise ReductionError(str(error)) from error
            return self._encoded(TYPES[CLOUD], message, key)
        raise ReductionError("messages of type {} cannot be reduced".format(key.name))

    def _decoded(self, key: TypeKey, payload: bytes) -> Dict[str, Any]:
        definition = TYPES[ros1_type(key.name)]
        if self._ros_version == 1 and key.checksum != definition.md5sum:
            raise ReductionError("{}: expected md5sum {}, found {}".format(key.name, definition.md5sum, key.checksum))
        try:
            return decode(definition, payload, self._ros_version)
        except CodecError as error:
            raise ReductionError(str(error)) from error

    def _encoded(self, definition: MessageDefinition, message: Dict[str, Any], source: TypeKey) -> Reduced:
        payload = encode(definition, message, self._ros_version)
        if self._ros_version == 1:
            return Reduced(TypeKey(definition.name, definition.md5sum), definition.text, payload)
        checksum = source.checksum
        quality = parse_quality(checksum)
        if quality is not None and ros1_type(source.name) != definition.name:
            # the hash is that of the source's type
            checksum = quality_text(quality._replace(type_hash=""))
        return Reduced(TypeKey(ros2_type(definition.name), checksum), "", payload)


def _jpeg(message: Dict[str, Any], options: JpegOptions, detail: float, *, is_raw: bool) -> Dict[str, Any]:
    """A sensor_msgs/CompressedImage of an Image or CompressedImage."""
    from udp_mesh.bridges.images import ImageError, jpeg_of_compressed, jpeg_of_raw

    quality = jpeg_quality(options, detail)
    try:
        make = jpeg_of_raw if is_raw else jpeg_of_compressed
        data = make(message, quality, options.scale)
    except ImageError as error:
        raise ReductionError(str(error)) from error
    return {"header": message["header"], "format": "jpeg", "data": Numbers("B", data)}
