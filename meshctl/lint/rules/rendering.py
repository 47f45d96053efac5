"""Trial rendering of every kind of node: templates, firewall, values (MC901 to MC905)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from meshctl import uci
from meshctl.diagnostics import Diagnostic, InvalidInput, Severity
from meshctl.file_access import located
from meshctl.lint.context import LintContext
from meshctl.lint.openwrt_names import one_edit_apart
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.trial_rendering import kinds, placeholder
from meshctl.model import Fleet, Node
from meshctl.render import Rendered
from meshctl.render.extra import EXTRA
from meshctl.render.template_files import NO_TEMPLATE, NOT_UCI, TEMPLATE
from meshctl.resolve import resolve
from meshctl.resolve.intent import BACKBONE, LAN
from meshctl.suggest import did_you_mean, suggestion
from meshctl.wording import join_limited

# a path in the inventory can be very long
_MAX_SHOWN_CHARACTERS = 200
_TEMPLATE_CODES = (TEMPLATE, NOT_UCI, NO_TEMPLATE, EXTRA)


@fleet_rule(
    "MC901",
    Severity.ERROR,
    "A template or a key of extra_uci fails",
    why="""A template of the inventory or of the back end's operator parts fails, its output is not valid UCI, or a key
    of `extra_uci` does not fit it: `provision` would stop there.""",
    fix="Fix it at the place that the finding names: a line of a template, or a key of `extra_uci`.",
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
    is_per_kind=True,
)
def management_shut_out(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, outcome in context.trial.of(fleet):
        if not isinstance(outcome, Rendered):
            continue
        for file in outcome.files:
            network = LAN if node.lan_address is None else BACKBONE
            if (
                file.package is not None
                and file.package.name == "firewall"
                and not _accepts_input(file.package, network)
            ):
                extra = next((("extra_uci", key) for key in node.extra_uci if key.startswith("firewall.")), ())
                expected = f"a zone of network {network} with input ACCEPT"
                yield Finding(("nodes", node.name, *extra), "SSH login would be blocked", expected, "none")


def _accepts_input(firewall: uci.Package, network: str) -> bool:
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
    is_per_kind=True,
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


@fleet_rule(
    "MC904",
    Severity.ERROR,
    "An option of extra_uci names something that is not there",
    why="""OpenWrt brings up a wireless interface on the radio that `device` names and attaches it to `network`. Zones,
    forwardings, rules, routes and DHCP ranges name networks and zones, too. Where the name is missing, OpenWrt does
    nothing: the access point is not on the air, its clients get no address, or their packets are rejected.""",
    fix="""Name a radio of the hardware profile, an interface of `network` such as `lan`, or a zone of the firewall such
    as `management`, by its option `name`.""",
    failing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio9, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.network: visitors, network.visitors: interface,
      network.visitors.proto: none}}}
    """,
    passing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.network: visitors, network.visitors: interface,
      network.visitors.proto: none}}}
    """,
    is_per_kind=True,
)
def extra_names_nothing(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for key, value, package, section, option in extra_entries(node, packages):
            needed = None if section is None else _REFERENCES.get((package, section.type, option))
            if needed is None:
                continue
            known = _names(packages, *needed)
            for word in value.split():
                if not _is_there(word, known, option):
                    path = ("nodes", node.name, "extra_uci", key)
                    hint = did_you_mean(word, known)
                    yield Finding(path, f"no {needed[1]} of {needed[0]}", f"one of {join_limited(known)}", word, hint)


class ExtraEntry(NamedTuple):
    """An entry of `extra_uci`: the option of a section, or, with an empty option and no section, a section's type."""

    key: str
    value: str
    package: str
    section: uci.Section | None
    option: str


def extra_entries(node: Node, packages: Mapping[str, uci.Package]) -> Iterator[ExtraEntry]:
    """The entries of a node's `extra_uci`, with the section that each one belongs to as it is rendered."""
    for key, value in node.extra_uci.items():
        package, _, rest = key.partition(".")
        name, _, option = rest.rpartition(".")
        if name:
            yield ExtraEntry(key, value, package, _section(packages.get(package), name), option)
        else:
            yield ExtraEntry(key, value, package, None, "")


def _section(package: uci.Package | None, key: str) -> uci.Section | None:
    """The section with this name or `@type[index]`."""
    keys = () if package is None else package.keys()
    return None if package is None or key not in keys else package.sections[keys.index(key)]


def _names(packages: Mapping[str, uci.Package], package: str, kind: str, option: str) -> list[str]:
    """The names of a package's sections of one type: their own, or the value of an option."""
    sections = packages[package].of_type(kind) if package in packages else ()
    names = (section.get(option) if option else section.name for section in sections)
    return [name for name in names if name]


def _is_there(word: str, known: list[str], option: str) -> bool:
    if option in ("src", "dest") and word == "*":
        return True
    # netifd makes wan_4 and wan_6 while wan is up
    return word in known or (word[-2:] in ("_4", "_6") and word[:-2] in known)


def with_extra(fleet: Fleet, context: LintContext) -> Iterator[tuple[Node, dict[str, uci.Package]]]:
    """The nodes with `extra_uci` that render, and their packages by name."""
    for node, outcome in context.trial.of(fleet):
        if node.extra_uci and isinstance(outcome, Rendered):
            yield node, {file.package.name: file.package for file in outcome.files if file.package is not None}


def with_parts(fleet: Fleet, context: LintContext) -> Iterator[tuple[Node, dict[str, uci.Package]]]:
    """As `with_extra`; of nodes that do not render, without the options that prevent it. For rules about what a package
    contains: what it lacks may be such an option."""
    yield from with_extra(fleet, context)
    for node, part in context.trial.parts_of(fleet):
        yield node, {file.package.name: file.package for file in part.files if file.package is not None}


def created_sections(
    node: Node, packages: Mapping[str, uci.Package], package: str
) -> Iterator[tuple[str, uci.Section]]:
    """The named sections that `extra_uci` creates in a package."""
    for section in packages[package].sections if package in packages else ():
        if section.name is not None and f"{package}.{section.name}" in node.extra_uci:
            yield section.name, section


_INTERFACE = ("network", "interface", "")
_ZONE = ("firewall", "zone", "name")
# package, section type and option -> package and type of the section that it names, and where that has the name
_REFERENCES = {
    ("wireless", "wifi-iface", "device"): ("wireless", "wifi-device", ""),
    ("wireless", "wifi-iface", "network"): _INTERFACE,
    ("network", "route", "interface"): _INTERFACE,
    ("network", "route6", "interface"): _INTERFACE,
    ("dhcp", "dhcp", "interface"): _INTERFACE,
    ("firewall", "zone", "network"): _INTERFACE,
    **{("firewall", kind, end): _ZONE for kind in ("forwarding", "rule", "redirect") for end in ("src", "dest")},
}


@fleet_rule(
    "MC905",
    Severity.WARNING,
    "A key of extra_uci creates a section that nothing reads",
    why="""A key of two parts creates a section, and its value is the section's type: `system.cronloglevel: "9"` is an
    empty section of the type 9, and the log level stays as it was. A misspelled package is a file of its own.""",
    fix="""An option has three parts: `"system.@system[0].cronloglevel": "9"`. Name packages as in /etc/config.""",
    failing="nodes: {b01: {extra_uci: {system.cronloglevel: '9'}}}",
    passing="""
    nodes: {b01: {extra_uci: {'system.@system[0].cronloglevel': '9', system.led1: led, system.led1.sysfs: usb}}}
    """,
    is_per_kind=True,
)
def extra_section_unread(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node in kinds(fleet):
        for key in node.extra_uci:
            package = key.partition(".")[0]
            near = one_edit_apart(package, _OWNED)
            if near:
                path = ("nodes", node.name, "extra_uci", key)
                yield Finding(path, "no program reads this package", " or ".join(near), package, suggestion(near))
    for node, packages in with_extra(fleet, context):
        for key, value in node.extra_uci.items():
            package, _, section = key.partition(".")
            made = packages[package].section(section) if package in packages and "." not in section else None
            others = (
                []
                if made is None
                else [
                    other_section
                    for other_section in packages[package].sections
                    if other_section is not made and other_section.options
                ]
            )
            # an empty section of a known type may have a meaning: all its defaults
            if made is not None and not made.options and others and made.type not in {other.type for other in others}:
                path = ("nodes", node.name, "extra_uci", key)
                message = f"creates an empty section of the type {value!r}"
                yield Finding(path, message, f"an option, such as {package}.@{others[0].type}[0].{section}", key)


# the packages that every node has
_OWNED = ("dhcp", "dropbear", "firewall", "network", "system", "wireless")
