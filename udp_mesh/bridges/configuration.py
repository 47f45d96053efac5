"""The bridge's own file, YAML -> values. Needs PyYAML, which both versions of ROS bring. docs/bridges.md.

    topics:
      map: { depth: 5 }
      camera: { rate_hz: 1, encode: { quality: 40, scale: 0.5 }, adapt: true }
      cloud: { rate_hz: 2, voxel_m: 0.2, fields: [x, y, z] }
    tf: { rate_hz: 5 }
    services:
      /get_map: { timeout_s: 5 }
    actions:
      /move: { lost_s: 30 }
    receive:
      map: {}
      video: { rate_hz: 1, max_age_s: 2 }
    types:
      my_msgs/Gas: |
        Header header
        float32 ppm

All errors are reported, each with file, line and column.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

from udp_mesh.bridges.message_definition import DefinitionError, MessageDefinition
from udp_mesh.bridges.receiving import Receive
from udp_mesh.bridges.reduction import JpegOptions, Reduction


class TopicOptions(NamedTuple):
    """`depth`: history of a transient local ROS 2 publisher, which the graph does not report."""

    depth: Optional[int] = None
    reduction: Optional[Reduction] = None


class TfOptions(NamedTuple):
    """`/tf` is sent `rate_hz` times a second; with `merge`, the transforms of others are published on `/tf`."""

    rate_hz: float
    merge: bool


class ServiceOptions(NamedTuple):
    timeout_s: float = 10.0


class ActionOptions(NamedTuple):
    timeout_s: float = 10.0
    lost_s: float = 30.0


class BridgeConfiguration(NamedTuple):
    topics: Dict[str, TopicOptions]
    tf: Optional[TfOptions]
    services: Dict[str, ServiceOptions]
    actions: Dict[str, ActionOptions]
    types: Dict[str, MessageDefinition]
    receive: Tuple[Receive, ...] = ()

    @property
    def reductions(self) -> Dict[str, Reduction]:
        """By topic."""
        return {name: topic.reduction for name, topic in self.topics.items() if topic.reduction is not None}


EMPTY = BridgeConfiguration({}, None, {}, {}, {})


class BridgeConfigurationError(ValueError):
    """The file is refused; the text has one line per problem."""


def load_configuration(path: str) -> BridgeConfiguration:
    """Reads the file. Raises BridgeConfigurationError."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BridgeConfigurationError("{}: cannot be read: {}".format(path, error)) from error
    return parse_configuration(text, path)


def parse_configuration(text: str, path: str) -> BridgeConfiguration:
    """Raises BridgeConfigurationError."""
    import yaml  # only a bridge with a file needs it

    reader = _Reader(path)
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise BridgeConfigurationError("{}: {}".format(path, " ".join(str(error).split()))) from error
    if root is None:
        return EMPTY
    found = reader.mapping(root, "", {"topics", "tf", "services", "actions", "types", "receive"})
    configuration = BridgeConfiguration(
        {name: _topic(reader, node, at) for name, (node, at) in reader.named(found.get("topics"), "topics").items()},
        _tf(reader, found["tf"]) if "tf" in found else None,
        {
            name: ServiceOptions(**reader.numbers(node, at, {"timeout_s": (0.1, 3600)}))
            for name, (node, at) in reader.absolute(found.get("services"), "services").items()
        },
        {
            name: ActionOptions(**reader.numbers(node, at, {"timeout_s": (0.1, 3600), "lost_s": (0, 86400)}))
            for name, (node, at) in reader.absolute(found.get("actions"), "actions").items()
        },
        _types(reader, found.get("types")),
        tuple(
            Receive(name, **reader.numbers(node, at, {"rate_hz": (0.001, 1e6), "max_age_s": (0.001, 1e6)}))
            for name, (node, at) in reader.named(found.get("receive"), "receive").items()
        ),
    )
    if reader.problems:
        raise BridgeConfigurationError("\n".join(reader.problems))
    return configuration


class _Reader:
    """Reads YAML nodes, and collects what is wrong with them."""

    def __init__(self, path: str) -> None:
        self._path = path
        self.problems: List[str] = []

    def refuse(self, node: Any, at: str, expected: str, found: object, *, is_text: bool = True) -> None:
        mark = node.start_mark
        text = "{}:{}:{}: {}: expected {}, found {}".format(
            self._path, mark.line + 1, mark.column + 1, at or "file", expected, repr(found) if is_text else found
        )
        self.problems.append(text)

    def pairs(self, node: Any, at: str) -> List[Tuple[Any, Any]]:
        if node is None or (node.id == "scalar" and node.value in ("", "null", "~")):
            return []
        if node.id != "mapping":
            # never the text: a file that is one value may be a key file
            self.refuse(node, at, "a mapping", "a single value" if node.id == "scalar" else "a list", is_text=False)
            return []
        return list(node.value)

    def mapping(self, node: Any, at: str, known: "set[str]") -> Dict[str, Any]:
        found: Dict[str, Any] = {}
        for key, value in self.pairs(node, at):
            name = str(key.value)
            if name not in known:
                self.refuse(key, "{}{}".format(at and at + ".", name), "one of " + ", ".join(sorted(known)), name)
            elif name in found:
                self.refuse(key, "{}{}".format(at and at + ".", name), "each key once", name)
            else:
                found[name] = value
        return found

    def named(self, node: Any, at: str) -> Dict[str, Tuple[Any, str]]:
        return {str(key.value): (value, "{}.{}".format(at, key.value)) for key, value in self.pairs(node, at)}

    def absolute(self, node: Any, at: str) -> Dict[str, Tuple[Any, str]]:
        for key, _ in self.pairs(node, at):
            if not str(key.value).startswith("/"):
                self.refuse(key, at, "a name that starts with /", key.value)
        return self.named(node, at)

    def number(self, node: Any, at: str, least: float, most: float, kind: Callable[[str], Any] = float) -> Any:
        try:
            value = kind(node.value)
            if least <= value <= most:
                return value
        except (TypeError, ValueError):
            pass
        what = "a whole number" if kind is int else "a number"
        self.refuse(node, at, "{} from {:g} to {:g}".format(what, least, most), getattr(node, "value", None))
        return kind(str(int(least)))

    def numbers(self, node: Any, at: str, limits: "Dict[str, Tuple[float, float]]") -> Dict[str, Any]:
        found = self.mapping(node, at, set(limits))
        return {name: self.number(value, at + "." + name, *limits[name]) for name, value in found.items()}

    def texts(self, node: Any, at: str) -> Tuple[str, ...]:
        if node.id != "sequence" or not all(item.id == "scalar" for item in node.value):
            self.refuse(node, at, "a list of names", getattr(node, "value", None) if node.id == "scalar" else node.id)
            return ()
        return tuple(str(item.value) for item in node.value)

    def flag(self, node: Any, at: str) -> bool:
        if node.id != "scalar" or node.value not in ("true", "false"):
            self.refuse(node, at, "true or false", getattr(node, "value", None))
        return bool(node.value == "true")


_TOPIC_NUMBERS = {"rate_hz": (0.001, 1000.0), "voxel_m": (0.001, 100.0), "max_voxel_m": (0.001, 100.0)}


def _topic(reader: _Reader, node: Any, at: str) -> TopicOptions:
    found = reader.mapping(node, at, {"depth", "encode", "fields", "adapt", *_TOPIC_NUMBERS})
    depth = reader.number(found["depth"], at + ".depth", 1, 10_000, int) if "depth" in found else None
    if not set(found) - {"depth"}:
        return TopicOptions(depth)
    values = {
        name: reader.number(found[name], "{}.{}".format(at, name), *limits)
        for name, limits in _TOPIC_NUMBERS.items()
        if name in found
    }
    reduction = Reduction(
        values.get("rate_hz"),
        _jpeg(reader, found["encode"], at + ".encode") if "encode" in found else None,
        values.get("voxel_m"),
        values.get("max_voxel_m"),
        reader.texts(found["fields"], at + ".fields") if "fields" in found else (),
        reader.flag(found["adapt"], at + ".adapt") if "adapt" in found else False,
    )
    if reduction.adapt and not (reduction.rate_hz and (reduction.encode or reduction.max_voxel_m)):
        reader.refuse(found["adapt"], at + ".adapt", "rate_hz, and encode or max_voxel_m, beside it", "true")
    if reduction.max_voxel_m is not None and not (reduction.voxel_m or 1e9) <= reduction.max_voxel_m:
        reader.refuse(found["max_voxel_m"], at + ".max_voxel_m", "at least voxel_m", reduction.max_voxel_m)
    return TopicOptions(depth, reduction)


def _jpeg(reader: _Reader, node: Any, at: str) -> JpegOptions:
    found = reader.mapping(node, at, {"quality", "min_quality", "scale"})
    whole = {
        name: reader.number(found[name], "{}.{}".format(at, name), 1, 95, int)
        for name in ("quality", "min_quality")
        if name in found
    }
    scale = reader.number(found["scale"], at + ".scale", 0.01, 1) if "scale" in found else 1.0
    return JpegOptions(scale=scale, **whole)


def _tf(reader: _Reader, node: Any) -> TfOptions:
    found = reader.mapping(node, "tf", {"rate_hz", "merge"})
    rate_hz = reader.number(found["rate_hz"], "tf.rate_hz", 0.01, 1000) if "rate_hz" in found else 5.0
    return TfOptions(rate_hz, reader.flag(found["merge"], "tf.merge") if "merge" in found else False)


def _types(reader: _Reader, node: Any) -> Dict[str, MessageDefinition]:
    types: Dict[str, MessageDefinition] = {}
    for key, value in reader.pairs(node, "types"):
        name, at = str(key.value), "types.{}".format(key.value)
        if name.count("/") != 1 or value.id != "scalar":
            reader.refuse(key, at, "pkg/Type: the message's definition in ROS 1", name)
            continue
        try:
            types[name] = MessageDefinition(name, str(value.value))
        except DefinitionError as error:
            reader.refuse(value, at, "a complete definition ({})".format(error), str(value.value)[:40])
    return types
