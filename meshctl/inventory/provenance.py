"""The origin of every value, looked up on demand: a large fleet keeps one tree instead of a table of positions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from meshctl.inventory.layers import Layer, NodeSpec
from meshctl.inventory.ranges import expand
from meshctl.inventory.tree import MappingNode, Scalar, SequenceNode, Tree, child, descend, position_of
from meshctl.model import Origin

# Layer name of each section; `{}` is the entry's name.
_TITLES = {
    "hardware": "hardware {}",
    "meshes": "mesh {}",
    "groups": "group {}",
    "robots": "robot {}",
    "sites": "site {}",
    "topics": "topic {}",
    "defaults": "defaults",
}
# keys under which a robot lists nodes
_NODE_LISTS = ("nodes", "carries")


class Provenance(Mapping[tuple[str, ...], Origin]):
    """Paths such as `("nodes", "b03", "radios", "radio0", "tx_power_dbm")` to origins.

    A node's values have the node's path and the layer they come from; values of other sections have their own path,
    such as `("operators", "ssh_keys", "0")`. In a robot's lists of nodes a node's name is also a path,
    `("robots", "husky1", "carries", "b03")`: it refers to the element, perhaps a range, that contains the name.
    """

    __slots__ = ("_elements", "_robot_of", "_root", "_specs")

    def __init__(self, root: MappingNode, specs: Mapping[str, NodeSpec], robot_of: Mapping[str, str]) -> None:
        self._root = root
        self._specs = specs
        self._robot_of = robot_of
        self._elements: dict[tuple[str, ...], dict[str, str]] = {}

    def __getitem__(self, path: tuple[str, ...]) -> Origin:
        found = self._node(path) if path[:1] == ("nodes",) and len(path) > 1 else self._section(path)
        if found is None:
            raise KeyError(path)
        return found

    def __iter__(self) -> Iterator[tuple[str, ...]]:
        for section, tree in self._root.values.items():
            if section != "nodes":
                yield from _paths(tree, (section,))
        for name, spec in self._specs.items():
            below = {path for layer in spec.layers for path in _paths(layer.tree, ())}
            yield from (("nodes", name, *path) for path in sorted(below) if path[:1] != ("inherits",))
            if ("robot",) not in below and name in self._robot_of:
                yield ("nodes", name, "robot")
        if "nodes" in self._root.values:
            yield ("nodes",)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _section(self, path: tuple[str, ...]) -> Origin | None:
        if path[:1] == ("robots",) and len(path) == 4 and path[2] in _NODE_LISTS:
            path = (*path[:3], self._element(path[:3]).get(path[3], path[3]))
        place = position_of(self._root, path) if path else None
        if place is None:
            return None
        title = _TITLES.get(path[0], "fleet")
        return Origin(place, title.format(path[1]) if len(path) > 1 else "fleet" if "{}" in title else title)

    def _element(self, path: tuple[str, ...]) -> dict[str, str]:
        """The index (as text) of each node in a robot's list."""
        found = self._elements.get(path)
        if found is None:
            found = self._elements[path] = {}
            tree = descend(self._root, path)
            items = tree.items if isinstance(tree, SequenceNode) else ()
            for number, item in enumerate(items):
                if isinstance(item, Scalar):
                    for name in expand(item.text):
                        found.setdefault(name, str(number))
        return found

    def _node(self, path: tuple[str, ...]) -> Origin | None:
        spec = self._specs.get(path[1])
        below = path[2:]
        if spec is None or below[:1] == ("inherits",):
            return None
        for layer in spec.layers:
            if below and not _writes(layer, below):
                continue
            is_rule = below == ("address",) and isinstance(child(layer.tree, "address"), MappingNode)
            return Origin(layer.position_of(below), "rule" if is_rule else layer.title)
        robot = self._robot_of.get(spec.name)
        if below == ("robot",) and robot is not None:
            return self._section(("robots", robot))
        return None


def _writes(layer: Layer, path: tuple[str, ...]) -> bool:
    tree: Tree | None = layer.tree
    for part in path:
        tree = None if tree is None else child(tree, part)
    return tree is not None


def _paths(tree: Tree, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Every path in `tree`, containers before their content."""
    yield path
    match tree:
        case MappingNode():
            for key, value in tree.values.items():
                yield from _paths(value, (*path, key))
        case SequenceNode():
            for number, item in enumerate(tree.items):
                yield from _paths(item, (*path, str(number)))
        case Scalar():
            pass
