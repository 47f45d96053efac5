"""The bridge's own file, YAML -> values. Needs PyYAML, which both versions of ROS bring. docs/bridges.md.

    topics:
      map: { depth: 5 }
    tf: { rate_hz: 5 }
    services:
      /get_map: { timeout_s: 5 }
    actions:
      /move: { lost_s: 30 }
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


class TopicOptions(NamedTuple):
    """`depth`: history of a transient local ROS 2 publisher, which the graph does not report."""

    depth: Optional[int] = None


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
    found = reader.mapping(root, "", {"topics", "tf", "services", "actions", "types"})
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
    )
    if reader.problems:
        raise BridgeConfigurationError("\n".join(reader.problems))
    return configuration


class _Reader:
    """Reads YAML nodes, and collects what is wrong with them."""

    def __init__(self, path: str) -> None:
        self._path = path
        self.problems: List[str] = []

    def refuse(self, node: Any, at: str, expected: str, found: object) -> None:
        mark = node.start_mark
        text = "{}:{}:{}: {}: expected {}, found {!r}".format(
            self._path, mark.line + 1, mark.column + 1, at or "file", expected, found
        )
        self.problems.append(text)

    def pairs(self, node: Any, at: str) -> List[Tuple[Any, Any]]:
        if node is None or (node.id == "scalar" and node.value in ("", "null", "~")):
            return []
        if node.id != "mapping":
            self.refuse(node, at, "a mapping", node.value if node.id == "scalar" else node.id)
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

    def flag(self, node: Any, at: str) -> bool:
        if node.id != "scalar" or node.value not in ("true", "false"):
            self.refuse(node, at, "true or false", getattr(node, "value", None))
        return bool(node.value == "true")


def _topic(reader: _Reader, node: Any, at: str) -> TopicOptions:
    found = reader.mapping(node, at, {"depth"})
    return TopicOptions(reader.number(found["depth"], at + ".depth", 1, 10_000, int) if "depth" in found else None)


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
