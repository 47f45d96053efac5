"""All rules, in the order of their codes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from types import MappingProxyType, ModuleType

from meshctl.lint.rule import Rule
from meshctl.lint.rules import (
    access,
    addresses,
    bridge,
    cell,
    cell_plan,
    channel,
    collectors,
    computers,
    drivers,
    encryption,
    extra_addresses,
    extra_dhcp,
    extra_firewall,
    extra_interfaces,
    extra_networks,
    extra_radios,
    extra_services,
    extra_values,
    firmware,
    hardware,
    housekeeping,
    identity,
    inventory_files,
    legacy,
    mtu,
    networks,
    packages,
    positions,
    power,
    reductions,
    references,
    relays,
    rendering,
    rollout,
    routed_lans,
    routing,
    secrets,
    sites,
    sizes,
    switches,
    system,
    team,
    thin_links,
    topic_delivery,
    topics,
    traffic,
    typography,
    uplinks,
)

# the chapters of the documentation, each a module of rules
CHAPTERS: tuple[tuple[str, ModuleType], ...] = (
    ("Suppressions and the baseline", housekeeping),
    ("Typing", typography),
    ("Files of the inventory", inventory_files),
    ("References", references),
    ("Sites", sites),
    ("Identity", identity),
    ("Addresses", addresses),
    ("Networks", networks),
    ("Robots' own LANs", routed_lans),
    ("Default routes", uplinks),
    ("Clocks and logs", system),
    ("The cell", cell),
    ("The plan of cells", cell_plan),
    ("Channel and country", channel),
    ("Power", power),
    ("Encryption", encryption),
    ("Login", access),
    ("Secrets", secrets),
    ("Routing", routing),
    ("MTU", mtu),
    ("Bridging", bridge),
    ("Switches", switches),
    ("Robots and roles", team),
    ("Positions", positions),
    ("Changes", rollout),
    ("The robots' computers", computers),
    ("Collectors", collectors),
    ("Topics", topics),
    ("Delivery of topics", topic_delivery),
    ("Reduced topics", reductions),
    ("Load, ports and timers", traffic),
    ("Legacy robots", legacy),
    ("Relays", relays),
    ("Thin links", thin_links),
    ("Firmware", firmware),
    ("Hardware and packages", hardware),
    ("Names of packages", packages),
    ("Memory and flash", sizes),
    ("Drivers", drivers),
    ("Rendering", rendering),
    ("Further services", extra_services),
    ("Further networks", extra_networks),
    ("Further values", extra_values),
    ("Further radios", extra_radios),
    ("Further interfaces", extra_interfaces),
    ("Further address servers", extra_dhcp),
    ("Further firewall zones", extra_firewall),
    ("Further addresses", extra_addresses),
)


def rules_of(module: ModuleType) -> Iterator[Rule]:
    """The rules of a module, in source order."""
    return (value for value in vars(module).values() if isinstance(value, Rule))


def _all() -> tuple[Rule, ...]:
    rules = sorted((rule for _, module in CHAPTERS for rule in rules_of(module)), key=lambda rule: rule.code)
    for first, second in pairwise(rules):
        if first.code == second.code:
            raise ValueError(f"duplicate rule code {first.code}: {first.name} and {second.name}")
    return tuple(rules)


RULES: tuple[Rule, ...] = _all()
BY_CODE = MappingProxyType({rule.code: rule for rule in RULES})
