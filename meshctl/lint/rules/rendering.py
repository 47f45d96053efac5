"""Trial rendering of every kind of node: templates, firewall, values (MC901 to MC903)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from meshctl import uci
from meshctl.diagnostics import InvalidInput, Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Fleet, Node, Secret, SecretRef
from meshctl.render import Rendered, Templates, render
from meshctl.render.extra import EXTRA
from meshctl.render.template_files import NO_TEMPLATE, NOT_UCI, TEMPLATE
from meshctl.resolve import resolve
from meshctl.resolve.intent import BACKBONE, LAN

# replaces every secret: a valid passphrase that never leaves this module
_PLACEHOLDER = Secret("placeholder-for-lint")
# a path in the inventory can be very long
_MAX_SHOWN_CHARACTERS = 200
_TEMPLATE_CODES = (TEMPLATE, NOT_UCI, NO_TEMPLATE, EXTRA)


def _placeholder(_ref: SecretRef) -> Secret:
    return _PLACEHOLDER


def _kinds(fleet: Fleet) -> Iterator[Node]:
    """One managed node of every kind: nodes that differ only in name and address render alike."""
    seen = set()
    for node in fleet.managed():
        if not all(name in fleet.meshes for name in node.meshes):
            continue
        kind = (
            node.hardware.name,
            node.release,
            tuple((radio.mesh, radio.tx_power_dbm) for radio in node.radios),
            node.lan_ports,
            tuple(node.extra_uci.items()),
            node.gateway is None,
            node.lan_address is None,
        )
        if kind not in seen:
            seen.add(kind)
            yield node


def _holds_own_text(fleet: Fleet, node: Node) -> bool:
    """Whether the node uses templates or options of the operator; the shipped templates are tested with meshctl."""
    own_templates = (Path(fleet.base) / "templates").is_dir()
    return own_templates or bool(node.extra_uci) or any(fleet.meshes[m].operator_parts.templates for m in node.meshes)


@fleet_rule(
    "MC901",
    Severity.ERROR,
    "A template fails or does not produce UCI",
    why="""A template of the inventory or of the back end's operator parts fails, or its output is not valid UCI:
    `provision` would stop there.""",
    fix="Fix the template; `meshctl render NODE` shows the location.",
    failing=Example(
        "apply: {max_down: 1}", files={"templates/common/etc/config/extra.j2": "config {{ intent.no_such_value }}\n"}
    ),
    passing=Example(
        "apply: {max_down: 1}", files={"templates/common/etc/config/extra.j2": "config led\n\toption name 'mesh'\n"}
    ),
)
def template_fails(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    seen = set()
    for _, outcome in _rendered(fleet):
        if isinstance(outcome, Rendered):
            continue
        if isinstance(outcome, OSError):
            found = f"{outcome.filename or 'it'}: {outcome.strerror}"[:_MAX_SHOWN_CHARACTERS]
            yield Finding(("meshes",), "templates cannot be read", "a folder of templates", found)
            return
        for item in outcome.diagnostics:
            if item.code in _TEMPLATE_CODES and (item.position, item.message) not in seen:
                seen.add((item.position, item.message))
                yield Finding((), item.message, item.expected, item.found, item.hint, item.position)


@fleet_rule(
    "MC902",
    Severity.ERROR,
    "No firewall zone accepts the management network",
    why="""From 23.05 on, OpenWrt rejects traffic that no zone allows, and meshctl's template does so on every release.
    It renders a zone for the management network; a template of your own or `extra_uci` that drops or closes this zone
    locks the operator out.""",
    fix="""Keep a zone with `list network 'lan'` (on a router of a robot's LAN: `backbone`) and `option input 'ACCEPT'`
    in the firewall package.""",
    failing="nodes: {b01: {extra_uci: {firewall.management.input: REJECT}}}",
    passing="nodes: {b01: {extra_uci: {firewall.management.masq: '1'}}}",
)
def management_shut_out(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node, outcome in _rendered(fleet):
        if not isinstance(outcome, Rendered):
            continue
        for file in outcome.files:
            network = LAN if node.lan_address is None else BACKBONE
            if file.package is not None and file.package.name == "firewall" and not _lets_in(file.package, network):
                extra = next((("extra_uci", key) for key in node.extra_uci if key.startswith("firewall.")), ())
                expected = f"a zone of network {network} with input ACCEPT"
                yield Finding(("nodes", node.name, *extra), "SSH login would be blocked", expected, "none")


def _lets_in(firewall: uci.Package, network: str) -> bool:
    for section in firewall.sections:
        is_open = section.get("input").upper() == "ACCEPT"
        if is_open and section.type == "zone" and network in section.get("network").split():
            return True
        if is_open and section.type == "defaults":
            return True
    return False


def _rendered(fleet: Fleet) -> Iterator[tuple[Node, Rendered | InvalidInput | OSError]]:
    """Every kind of node with its files, or the error that prevents rendering."""
    templates = Templates.of(fleet)
    for node in _kinds(fleet):
        if not _holds_own_text(fleet, node):
            continue
        try:
            intent = resolve(fleet, node, _placeholder)
        except InvalidInput:
            # MC903 reports invalid values
            continue
        try:
            outcome: Rendered | InvalidInput | OSError = render(intent, templates)
        except (InvalidInput, OSError) as error:
            outcome = error
        yield node, outcome


@fleet_rule(
    "MC903",
    Severity.ERROR,
    "A value cannot be written into the node's files",
    why="""UCI can hold any text, but its consumers cannot: netifd's scripts put values into shell commands, and the
    supplicant reads lines. `meshctl render` refuses such a value; lint reports all of them at once. This rule is silent
    where a more specific rule reports the same place.""",
    fix="Write the value as expected.",
    failing="nodes: {b01: {extra_uci: {'wireless.radio0 .rts': '500'}}}",
    passing="nodes: {b01: {extra_uci: {wireless.radio0.rts: '500'}}}",
    is_fallback=True,
)
def value_unwritable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    seen = set()
    for node in _kinds(fleet):
        try:
            resolve(fleet, node, _placeholder)
        except InvalidInput as error:
            for item in error.diagnostics:
                if (item.position, item.path) not in seen:
                    seen.add((item.position, item.path))
                    path = tuple(item.path.split("."))
                    yield Finding(path, item.message, item.expected, item.found, item.hint, item.position)
