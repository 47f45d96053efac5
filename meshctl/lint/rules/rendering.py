"""Trial rendering of every kind of node: templates, firewall, values (MC901 to MC903)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl import uci
from meshctl.diagnostics import Diagnostic, InvalidInput, Severity
from meshctl.file_access import located
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.trial_rendering import kinds, placeholder
from meshctl.model import Fleet, Node
from meshctl.render import Rendered
from meshctl.render.extra import EXTRA
from meshctl.render.template_files import NO_TEMPLATE, NOT_UCI, TEMPLATE
from meshctl.resolve import resolve
from meshctl.resolve.intent import BACKBONE, LAN

# a path in the inventory can be very long
_MAX_SHOWN_CHARACTERS = 200
_TEMPLATE_CODES = (TEMPLATE, NOT_UCI, NO_TEMPLATE, EXTRA)


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
def template_fails(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    seen = set()
    for node, outcome in context.trial.of(fleet):
        if isinstance(outcome, Rendered):
            continue
        if isinstance(outcome, OSError):
            found = f"{outcome.filename or 'it'}: {outcome.strerror}"[:_MAX_SHOWN_CHARACTERS]
            yield Finding(("meshes",), "templates cannot be read", "a folder of templates", found)
            return
        for item in outcome.diagnostics:
            if item.code in _TEMPLATE_CODES and (item.position, item.message) not in seen:
                seen.add((item.position, item.message))
                yield _named_folder(fleet, node, item) or Finding(
                    (), item.message, item.expected, item.found, item.hint, item.position
                )


def _named_folder(fleet: Fleet, node: Node, item: Diagnostic) -> Finding | None:
    """The finding about a folder of operator parts, at the line of the inventory that names it."""
    for name in node.meshes:
        parts = fleet.meshes[name].operator_parts
        if parts.templates and item.position.file == str(located(parts.base, parts.templates)):
            path = ("meshes", name, "operator_parts", "templates")
            found = item.found and f"{item.found} at {parts.templates}"[:_MAX_SHOWN_CHARACTERS]
            hint = item.hint or "Add what is missing, or correct the path: it is relative to this file."
            return Finding(path, item.message, item.expected, found, hint)
    return None


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
def management_shut_out(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, outcome in context.trial.of(fleet):
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
    for node in kinds(fleet):
        try:
            resolve(fleet, node, placeholder)
        except InvalidInput as error:
            for item in error.diagnostics:
                if (item.position, item.path) not in seen:
                    seen.add((item.position, item.path))
                    path = tuple(item.path.split("."))
                    yield Finding(path, item.message, item.expected, item.found, item.hint, item.position)
