"""Resolve the layers of each node: expand ranges, follow groups, order the layers from highest to lowest precedence.

Precedence: defaults < groups (parents before children, earlier before later) < range < the node's own entry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from meshctl.diagnostics import Diagnostic, Position
from meshctl.inventory import codes
from meshctl.inventory.compose import printable
from meshctl.inventory.documents import InventoryDocument, NodeDocument, NodeLayer
from meshctl.inventory.fields import is_name
from meshctl.inventory.ranges import MAX_NAMES, BadRange, expand, is_range
from meshctl.inventory.tree import MappingNode, Tree, descend, position, position_of
from meshctl.suggest import did_you_mean


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """A mapping with values of nodes. `title` is its name in an origin; `path` is its location in the inventory."""

    title: str
    path: tuple[str, ...]
    document: NodeLayer
    tree: Tree
    place: Position

    def position_of(self, path: Sequence[str | int]) -> Position:
        """The position of `path` in the layer; the layer's own position if it does not set `path`."""
        return (position_of(self.tree, path) if path else None) or self.place


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """A node to build: its layers, highest precedence first, its groups, and its index (from 1) in its range."""

    name: str
    layers: tuple[Layer, ...]
    groups: tuple[str, ...]
    range_index: int = 0

    @property
    def entry(self) -> Layer:
        """The layer at which errors of the node are reported."""
        return self.layers[0]


@dataclass(frozen=True, slots=True)
class ResolvedLayers:
    """`nodes` are in the inventory's order."""

    nodes: dict[str, NodeSpec]
    diagnostics: tuple[Diagnostic, ...]


def resolve_layers(document: InventoryDocument, root: MappingNode) -> ResolvedLayers:
    """Resolve the layers of every node; reports unknown groups and inheritance cycles."""
    return _LayerResolver(document, root).run()


@dataclass(slots=True)
class _Entry:
    """A key of `nodes`: its layer and, for a range, the index of the name."""

    layer: Layer
    document: NodeDocument
    index: int = 0


@dataclass(slots=True)
class _LayerResolver:
    document: InventoryDocument
    root: MappingNode
    diagnostics: list[Diagnostic] = field(default_factory=list)
    _groups: dict[str, Layer] = field(default_factory=dict)
    _broken: set[str] = field(default_factory=set)
    _stacks: dict[tuple[str, ...], tuple[Layer, ...] | None] = field(default_factory=dict)
    _joined: dict[tuple[int, ...], tuple[Layer, ...]] = field(default_factory=dict)

    def run(self) -> ResolvedLayers:
        for name, group in self.document.groups.items():
            self._groups[name] = self._layer(f"group {name}", ("groups", name), group)
        for name, group in self.document.groups.items():
            for number, parent in enumerate(group.inherits):
                self._check_known(parent, self._groups[name], "inherits", number)
        self._find_cycles()
        defaults = (self._layer("defaults", ("defaults",), self.document.defaults),)
        specs: dict[str, NodeSpec] = {}
        for name, entries in self._entries().items():
            own = tuple(entry.layer for entry in entries)
            groups = next(
                (entry.document.groups for entry in entries if "groups" in entry.document.model_fields_set), ()
            )
            stack = self._group_layers(groups)
            if stack is not None:
                key = (*map(id, own), *map(id, stack))
                layers = self._joined.setdefault(key, (*own, *stack, *defaults))
                specs[name] = NodeSpec(name, layers, groups, entries[-1].index)
        return ResolvedLayers(specs, tuple(self.diagnostics))

    def _layer(self, title: str, path: tuple[str, ...], document: NodeLayer) -> Layer:
        tree = descend(self.root, path)
        if tree is None:
            # `defaults` is not set.
            tree = MappingNode(self.root.file, self.root.line, self.root.column, 0, 0, is_flow=True)
        return Layer(title, path, document, tree, position_of(self.root, path) or position(self.root))

    def _find_cycles(self) -> None:
        """Depth-first search over the parents; an edge back to the trail closes a cycle."""
        done: set[str] = set()
        for first in self._groups:
            trail: dict[str, None] = {}
            pending = [(first, False)]
            while pending:
                name, is_leaving = pending.pop()
                if is_leaving:
                    del trail[name]
                    done.add(name)
                elif name in trail:
                    names = list(trail)
                    self._report_cycle([*names[names.index(name) :], name])
                elif name not in done and name in self._groups:
                    trail[name] = None
                    pending.append((name, True))
                    pending.extend((parent, False) for parent in reversed(self.document.groups[name].inherits))

    def _report_cycle(self, names: list[str]) -> None:
        self._broken.update(names)
        layer = self._groups[names[0]]
        message = f"inheritance cycle of groups: {' -> '.join(names[:20])}"
        self.diagnostics.append(
            codes.error(
                codes.GROUP_CYCLE, layer.position_of(("inherits",)), message, path=f"groups.{names[0]}.inherits"
            )
        )

    def _check_known(self, name: str, layer: Layer, key: str, number: int) -> None:
        if name in self._groups:
            return
        place = layer.position_of((key, number))
        self.diagnostics.append(
            codes.error(
                codes.UNKNOWN_GROUP,
                place,
                f"unknown group '{printable(name)}'",
                path=".".join((*layer.path, key)),
                hint=did_you_mean(name, self._groups),
            )
        )

    def _group_layers(self, groups: tuple[str, ...]) -> tuple[Layer, ...] | None:
        """The groups' layers, highest precedence first, each group once at its lowest precedence; None if a group is
        unknown or part of a cycle, which is already reported."""
        if groups not in self._stacks:
            self._stacks[groups] = self._linearize(groups)
        return self._stacks[groups]

    def _linearize(self, groups: tuple[str, ...]) -> tuple[Layer, ...] | None:
        ordered: list[Layer] = []
        seen: set[str] = set()
        pending = [(name, False) for name in reversed(groups)]
        while pending:
            name, is_leaving = pending.pop()
            if name in self._broken or name not in self._groups:
                return None
            if is_leaving:
                ordered.append(self._groups[name])
            elif name not in seen:
                seen.add(name)
                pending.append((name, True))
                pending.extend((parent, False) for parent in reversed(self.document.groups[name].inherits))
        return tuple(reversed(ordered))

    def _entries(self) -> dict[str, list[_Entry]]:
        """The entries of each node, its own before its range's."""
        made: dict[str, list[_Entry]] = {}
        for pattern, document in self.document.nodes.items():
            ranged = is_range(pattern)
            layer = self._layer(f"range {pattern}" if ranged else "node", ("nodes", pattern), document)
            for number, group in enumerate(document.groups):
                self._check_known(group, layer, "groups", number)
            names = self._names(pattern, layer)
            if len(made) + len(names) > MAX_NAMES:
                self._refuse(layer, f"too many nodes (at most {MAX_NAMES})")
                break
            for index, name in enumerate(names, start=1):
                entries = made.setdefault(name, [])
                if not ranged:
                    entries.insert(0, _Entry(layer, document))
                elif entries and entries[-1].index:
                    first = entries[-1].layer
                    self.diagnostics.append(
                        codes.error(
                            codes.NODE_TWICE,
                            layer.place,
                            f"node '{name}' is also in range '{first.path[1]}'",
                            path=f"nodes.{pattern}",
                            found=f"also in {first.place}",
                        )
                    )
                    break
                else:
                    entries.append(_Entry(layer, document, index))
        return made

    def _names(self, pattern: str, layer: Layer) -> tuple[str, ...]:
        try:
            names = expand(pattern)
        except BadRange as reason:
            self._refuse(layer, f"invalid range (expected e.g. b[01-12]): {reason}")
            return ()
        wrong = next((name for name in names if not is_name(name)), None)
        if wrong is not None:
            self._refuse(
                layer, f"'{printable(wrong)}' is not a name of at most 63 letters (a to z), digits, '.', '_' and '-'"
            )
            return ()
        return names

    def _refuse(self, layer: Layer, message: str) -> None:
        self.diagnostics.append(
            codes.error(codes.BAD_RANGE, layer.place, message, path=printable(".".join(layer.path)))
        )
