"""Render every kind of node for rules that judge the result, with a placeholder for each secret."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator
from dataclasses import replace
from pathlib import Path

from meshctl.diagnostics import InvalidInput
from meshctl.model import Fleet, Node, Secret, SecretRef
from meshctl.render import Rendered, Templates, render
from meshctl.resolve import resolve, resolve_unchecked

Outcome = Rendered | InvalidInput | OSError

# a valid passphrase that never leaves lint
_PLACEHOLDER = Secret("placeholder-for-lint")


class TrialRendering:
    """The outcomes for the last fleet, so that several rules share them: an inventory's own templates are rendered in
    a process of their own, which takes longer to start than all other rules together."""

    def __init__(self) -> None:
        self._fleet: Fleet | None = None
        self._outcomes: tuple[tuple[Node, Outcome], ...] = ()
        self._parts: tuple[tuple[Node, Rendered], ...] | None = None

    def of(self, fleet: Fleet) -> tuple[tuple[Node, Outcome], ...]:
        """Every kind of node with own templates or options, and its files or the error that prevents rendering."""
        if self._fleet is not fleet:
            self._outcomes = tuple(_rendered(fleet))
            self._fleet, self._parts = fleet, None
        return self._outcomes

    def parts_of(self, fleet: Fleet) -> tuple[tuple[Node, Rendered], ...]:
        """Those nodes with own options that do not render, without the options that prevent it, as far as possible."""
        rendered = {node.name for node, outcome in self.of(fleet) if isinstance(outcome, Rendered)}
        if self._parts is None:
            self._parts = tuple(_parts(fleet, rendered))
        return self._parts


def placeholder(_ref: SecretRef) -> Secret:
    """Stands for every secret."""
    return _PLACEHOLDER


def kinds(fleet: Fleet) -> Iterator[Node]:
    """One managed node of every kind: nodes that differ only in name and address render alike."""
    seen = set()
    for node in fleet.managed():
        if not all(name in fleet.meshes for name in node.meshes):
            continue
        kind = kind_of(node)
        if kind not in seen:
            seen.add(kind)
            yield node


def kind_of(node: Node) -> Hashable:
    """The properties that nodes of one kind share."""
    return (
        node.hardware.name,
        node.release,
        tuple((radio.mesh, radio.tx_power_dbm) for radio in node.radios),
        node.lan_ports,
        tuple(node.extra_uci.items()),
        node.gateway is None,
        node.lan_address is None,
    )


def _rendered(fleet: Fleet) -> Iterator[tuple[Node, Outcome]]:
    templates: Templates | None = None
    for node in kinds(fleet):
        if not _holds_own_text(fleet, node):
            continue
        try:
            templates = templates or Templates.of(fleet)
        except (InvalidInput, OSError) as error:
            yield node, error
            return
        try:
            intent = resolve(fleet, node, placeholder)
        except InvalidInput:
            # MC903 reports invalid values
            continue
        try:
            yield node, render(intent, templates)
        except (InvalidInput, OSError) as error:
            yield node, error


def _parts(fleet: Fleet, rendered: Collection[str]) -> Iterator[tuple[Node, Rendered]]:
    nodes = [node for node in kinds(fleet) if node.extra_uci and node.name not in rendered]
    if not nodes:
        return
    try:
        templates = Templates.of(fleet)
    except (InvalidInput, OSError):
        return
    for node in nodes:
        intent, found = resolve_unchecked(fleet, node, placeholder)
        # options of sections that are not created there fail when they are rendered
        for _ in range(2):
            wrong = {item.path.rpartition("extra_uci.")[2] for item in found}
            options = {key: value for key, value in intent.extra_uci.items() if key not in wrong}
            intent = replace(intent, extra_uci=options)
            try:
                part = render(intent, templates)
            except InvalidInput as error:
                found = error.diagnostics
            except OSError:
                break
            else:
                yield node, part
                break


def has_own_templates(fleet: Fleet) -> bool:
    """Whether the fleet's templates may add anything to what meshctl renders."""
    return (Path(fleet.base) / "templates").is_dir()


def _holds_own_text(fleet: Fleet, node: Node) -> bool:
    """Whether the node uses templates or options of the operator; the shipped templates are tested with meshctl."""
    return (
        has_own_templates(fleet)
        or bool(node.extra_uci)
        or any(fleet.meshes[m].operator_parts.templates for m in node.meshes)
    )
