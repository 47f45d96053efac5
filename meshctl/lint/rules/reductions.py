"""Topics whose messages the ROS bridge reduces (MC721 to MC729)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Fleet, Topic
from meshctl.model.computers import ROS_1
from meshctl.wording import join_limited

_IMAGES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
_CLOUDS = ("sensor_msgs/PointCloud2",)
_CAMERA = "topics: {camera: {priority: 9, type: sensor_msgs/Image, keep_last: 1, sources: [husky1], "
_HUSKY = "robots: {husky1: {computer: {ros: noetic}}}\n"


def _path(topic: Topic, *key: str) -> tuple[str, ...]:
    return ("topics", topic.name, "reduce", *key)


@fleet_rule(
    "MC721",
    Severity.ERROR,
    "A topic's type cannot be reduced in this way",
    why="""The bridge encodes images and thins out point clouds. A message of another type cannot be reduced, and is not
    sent at all, since the whole one may be larger than the link can carry.""",
    fix="""Remove `encode`, `voxel_m` or `fields`, or correct `type`: sensor_msgs/Image or CompressedImage for `encode`,
    sensor_msgs/PointCloud2 for `voxel_m` and `fields`. `rate_hz` works with every type.""",
    failing=_HUSKY + _CAMERA + "reduce: {voxel_m: 0.1}}}",
    passing=_HUSKY + _CAMERA + "reduce: {encode: {quality: 40}}}}",
)
def type_not_reducible(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        reduction, type_name = topic.reduce, topic.type_name.replace("/msg/", "/")
        if reduction is None or not type_name:
            continue
        for key, is_set, types in (
            ("encode", reduction.encode is not None, _IMAGES),
            ("voxel_m", reduction.voxel_m is not None, _CLOUDS),
            ("fields", bool(reduction.fields), _CLOUDS),
        ):
            if is_set and type_name not in types:
                expected = f"the type {' or '.join(types)}"
                yield Finding(_path(topic, key), f"{topic.name} would not be sent", expected, topic.type_name)


@fleet_rule(
    "MC722",
    Severity.ERROR,
    "A topic cannot be adapted",
    why="""The bridge adapts the quality to the time that messages take to arrive, at a known rate. Messages of a
    best-effort topic have no outcome; without `keep_last: 1`, late messages queue and all later ones are late, too.""",
    fix="""Set `reliable: true`, `keep_last: 1` and `reduce.rate_hz`, and what may be varied: `encode` (down to
    `min_quality`), or `voxel_m` with `max_voxel_m`. Or remove `adapt`.""",
    failing=_HUSKY + _CAMERA + "reliable: false, reduce: {rate_hz: 1, encode: {quality: 40}, adapt: true}}}",
    passing=_HUSKY + _CAMERA + "reduce: {rate_hz: 1, encode: {quality: 40}, adapt: true}}}",
)
def not_adaptable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        reduction = topic.reduce
        if reduction is None or not reduction.adapt:
            continue
        place = ("topics", topic.name)
        if not topic.reliable:
            yield Finding((*place, "reliable"), "its messages have no outcome", "true", "false")
        if topic.keep_last != 1:
            yield Finding((*place, "keep_last"), "late messages queue", "1", str(topic.keep_last))
        if reduction.rate_hz is None:
            yield Finding(_path(topic, "adapt"), "its period is unknown", "rate_hz beside adapt", "none")
        if reduction.encode is None and (reduction.voxel_m is None or reduction.max_voxel_m is None):
            yield Finding(_path(topic, "adapt"), "nothing to vary", "encode, or voxel_m and max_voxel_m", "neither")


@fleet_rule(
    "MC723",
    Severity.ERROR,
    "The bounds of an adapted topic are reversed",
    why="The finest setting is coarser than the coarsest one: there is nothing in between to choose from.",
    fix="Set `min_quality` to at most `quality`, and `max_voxel_m` to at least `voxel_m`.",
    failing=_HUSKY + _CAMERA + "reduce: {rate_hz: 1, encode: {quality: 10, min_quality: 30}, adapt: true}}}",
    passing=_HUSKY + _CAMERA + "reduce: {rate_hz: 1, encode: {quality: 30, min_quality: 10}, adapt: true}}}",
)
def bounds_reversed(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        reduction = topic.reduce
        if reduction is None:
            continue
        jpeg = reduction.encode
        if jpeg is not None and reduction.adapt and jpeg.min_quality > jpeg.quality:
            path, expected = _path(topic, "encode", "min_quality"), f"at most {jpeg.quality} (quality)"
            yield Finding(path, "coarser than the finest", expected, str(jpeg.min_quality))
        if reduction.max_voxel_m is not None and not (reduction.voxel_m or 1e9) <= reduction.max_voxel_m:
            path, expected = _path(topic, "max_voxel_m"), f"at least {reduction.voxel_m} (voxel_m)"
            yield Finding(path, "finer than the finest", expected, str(reduction.max_voxel_m))


@fleet_rule(
    "MC724",
    Severity.WARNING,
    "No deployed bridge reduces a topic",
    why=f"""`meshctl robots deploy` installs a ROS 1 bridge on computers with `ros: {ROS_1}`, with these settings. On
    other sources, the topic is sent as its program publishes it, unless their bridges have the settings, too.""",
    fix=f"""Set `ros: {ROS_1}` on the source's computer, or put the settings into the file of its ROS 2 bridge
    (docs/bridges.md) and suppress this finding.""",
    failing=_CAMERA + "reduce: {rate_hz: 1}}}",
    passing=_HUSKY + _CAMERA + "reduce: {rate_hz: 1}}}",
)
def not_reduced(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if topic.reduce is None:
            continue
        sources = (fleet.robots.get(name) for name in topic.sources or tuple(fleet.robots))
        lacking = [
            (robot.name, robot.computer.ros or "no ros")
            for robot in sources
            if robot is not None and robot.computer is not None and robot.computer.ros != ROS_1
        ]
        if lacking:
            found = join_limited([f"{name}: {ros}" for name, ros in lacking])
            expected = f"ros: {ROS_1} on their computers"
            yield Finding(_path(topic), "some sources have no deployed bridge", expected, found)


@fleet_rule(
    "MC729",
    Severity.WARNING,
    "A topic is reduced to more than is published",
    why="""`reduce.rate_hz` is the most that the bridge sends. Above the topic's own `rate_hz` it reduces nothing.""",
    fix="Set `reduce.rate_hz` below `rate_hz`, or correct `rate_hz`: it is what the robot's programs publish.",
    failing=_HUSKY + _CAMERA + "rate_hz: 1, size_bytes: 2000, reduce: {rate_hz: 30}}}",
    passing=_HUSKY + _CAMERA + "rate_hz: 30, size_bytes: 2000, reduce: {rate_hz: 1}}}",
)
def not_less(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        rate_hz = topic.reduce.rate_hz if topic.reduce is not None else None
        if rate_hz is not None and 0 < topic.rate_hz < rate_hz:
            expected = f"less than {topic.rate_hz:g} Hz (rate_hz)"
            yield Finding(_path(topic, "rate_hz"), "reduces nothing", expected, f"{rate_hz:g} Hz")
