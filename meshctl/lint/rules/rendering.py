"""Whether every kind of node can be rendered at all: templates (MC901)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from meshctl.diagnostics import InvalidInput, Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Fleet, Node, Secret, SecretRef
from meshctl.render import Templates, render
from meshctl.render.templates import NO_TEMPLATE, NOT_UCI, TEMPLATE
from meshctl.resolve import resolve

# stands for every secret: it is allowed as a passphrase, and never leaves this module
_PLACEHOLDER = Secret("placeholder-for-lint")
_TEMPLATE_CODES = (TEMPLATE, NOT_UCI, NO_TEMPLATE)


def _placeholder(_ref: SecretRef) -> Secret:
    return _PLACEHOLDER


def _kinds(fleet: Fleet) -> Iterator[Node]:
    """One managed node of every kind that the operator's own text goes into; nodes that differ in nothing but name and
    address render alike, and meshctl's own templates are tested with it."""
    own_templates = (Path(fleet.base) / "templates").is_dir()
    seen = set()
    for node in fleet.managed():
        if not all(name in fleet.meshes for name in node.meshes):
            continue
        if not (own_templates or node.extra_uci or any(fleet.meshes[m].operator_parts.templates for m in node.meshes)):
            continue
        kind = (
            node.hardware.name,
            node.release,
            node.role,
            tuple(radio.mesh for radio in node.radios),
            node.lan_ports,
            tuple(node.extra_uci.items()),
            node.gateway is None,
        )
        if kind not in seen:
            seen.add(kind)
            yield node


@fleet_rule(
    "MC901",
    Severity.ERROR,
    "A template fails, or writes no UCI",
    why="""The template of the operator's own (or of the back end's parts) stops, or writes text that OpenWrt cannot
    read: found out at the first `provision`, unless it is found out here.""",
    mend="Mend the template; `meshctl render NODE` shows its place.",
    failing=Example(
        "apply: {max_down: 1}", files={"templates/common/etc/config/extra.j2": "config {{ intent.no_such_value }}\n"}
    ),
    passing=Example(
        "apply: {max_down: 1}", files={"templates/common/etc/config/extra.j2": "config led\n\toption name 'mesh'\n"}
    ),
)
def template_fails(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    templates = Templates.of(fleet)
    seen = set()
    for node in _kinds(fleet):
        try:
            intent = resolve(fleet, node, _placeholder)
        except InvalidInput:
            # values that cannot be written down have rules of their own
            continue
        try:
            render(intent, templates)
        except InvalidInput as error:
            for item in error.diagnostics:
                if item.code in _TEMPLATE_CODES and (item.position, item.message) not in seen:
                    seen.add((item.position, item.message))
                    yield Finding((), item.message, item.expected, item.found, item.hint, item.position)
