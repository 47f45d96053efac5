"""A device's configuration compared with what its inventory entry renders to: every difference is named. Pure.

Sections are paired by what they are (a radio by its path, the mesh interface by its radio, a zone by its network), not
by their names, which meshctl chooses. Options that only the device has go into `extra_uci` where that keeps their
meaning; everything else is a difference that provisioning makes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from fnmatch import fnmatchcase

from meshctl.model import MASK
from meshctl.uci import Package, Section, Value, is_secret_option

# OpenWrt's own first-boot values, which say nothing about the operator's intention (config_generate, wifi config, and
# the packages' default files, 19.07 to 25.12).
STOCK: Mapping[tuple[str, str], Mapping[str, tuple[str, ...]]] = {
    ("system", "system"): {
        "urandom_seed": ("0",), "conloglevel": ("8",), "cronloglevel": ("7", "8"), "log_proto": ("udp",),
    },
    ("system", "timeserver"): {"use_dhcp": ("0", "1")},
    ("network", "interface"): {"ip6assign": ("60",), "multipath": ("off",)},
    ("wireless", "wifi-device"): {"cell_density": ("0",), "num_global_macaddr": ("1", "2", "8")},
    ("firewall", "defaults"): {"syn_flood": ("1",), "drop_invalid": ("0",), "flow_offloading": ("0",)},
    ("firewall", "zone"): {"masq": ("0",), "mtu_fix": ("0",)},
    ("dhcp", "odhcpd"): {
        "leasefile": ("/tmp/hosts/odhcpd",), "leasetrigger": ("/usr/sbin/odhcpd-update",), "loglevel": ("4",),
        "piodir": ("/tmp/odhcpd-piodir",), "piofolder": ("/tmp/odhcpd-piofolder",), "hostsdir": ("/tmp/hosts",),
    },
}  # fmt: skip
# Options whose meaning another rendered option has, in another form or another release's.
SUPERSEDED: Mapping[tuple[str, str], Mapping[str, str]] = {
    ("wireless", "wifi-device"): {"hwmode": "band", "legacy_rates": "mcast_rate"},
    ("wireless", "wifi-iface"): {"sae_password": "key", "mesh_fwding": "mesh_fwding"},
    ("network", "interface"): {
        "ifname": "device", "type": "device", "netmask": "ipaddr", "mesh": "master", "_orig_ifname": "device",
        "_orig_bridge": "device", "ipaddr": "ip6addr", "ip6addr": "ipaddr", "device": "device",
        "gateway": "gateway", "ip6gw": "ip6gw",
    },
    ("network", "device"): {"ifname": "ports"},
    ("dhcp", "dhcp"): dict.fromkeys(
        ("start", "limit", "leasetime", "dhcpv4", "dhcpv6", "ra", "ra_management", "ra_slaac", "ra_flags", "force",
         "dynamicdhcp", "ra_default", "ndp", "dhcp_option", "master"), "ignore",
    ),
    ("dropbear", "dropbear"): {"BannerFile": "PasswordAuth"},
}  # fmt: skip
# netifd reads a list and a text of words alike (uci_blob.c); other programs tell them apart.
_WORD_LISTS = frozenset({"network"})
_ROUTES = frozenset({("network", "route"), ("network", "route6")})


class Fate(Enum):
    """The effect of provisioning on an option or section."""

    CHANGED = "changed"
    REMOVED = "removed"
    ADDED = "added"


@dataclass(frozen=True, slots=True)
class Difference:
    """`key` as `uci` writes it; a section has no value but its options' `KEY=VALUE`. Secrets are masked. `reason` is
    why it is not kept."""

    fate: Fate
    key: str
    on_device: str = ""
    rendered: str = ""
    reason: str = ""

    @property
    def line(self) -> str:
        values = {
            Fate.CHANGED: f"{self.on_device} -> {self.rendered}",
            Fate.REMOVED: self.on_device,
            Fate.ADDED: self.rendered,
        }[self.fate]
        return f"{self.key}: {values}" + (f" ({self.reason})" if self.reason else "")


@dataclass(frozen=True, slots=True)
class Comparison:
    """`extra_uci` are the options that the inventory can keep; `differences` all others; `untouched` the packages that
    meshctl does not write, which stay on the device as they are."""

    extra_uci: Mapping[str, str]
    differences: tuple[Difference, ...]
    untouched: tuple[str, ...]


def compare(
    device: Mapping[str, Package],
    rendered: Mapping[str, Package],
    sections: Mapping[tuple[str, str], str],
    *,
    keep: Iterable[str] = (),
) -> Comparison:
    """`sections` gives the rendered names of the device's sections, (package, name) -> name; `keep` are patterns of
    whole sections (`network.wan*`) to put into `extra_uci`, too."""
    extra: dict[str, str] = {}
    differences: list[Difference] = []
    patterns = tuple(keep)
    for name, target in rendered.items():
        own = device.get(name, Package(name))
        pairs = _pairs(own, target, sections)
        target_keys, own_keys = target.keys(), own.keys()
        for index, other in pairs.items():
            found = own.sections[index]
            if other is not None:
                key = f"{name}.{target_keys[other]}"
                _options(name, key, found, target.sections[other], extra, differences)
            else:
                _section(name, f"{name}.{own_keys[index]}", found, patterns, extra, differences)
        paired = set(pairs.values())
        for position, section in enumerate(target.sections):
            if position not in paired:
                differences.append(
                    Difference(Fate.ADDED, f"{name}.{target_keys[position]}", rendered=_section_text(section))
                )
    untouched = tuple(sorted(name for name, package in device.items() if name not in rendered and package.sections))
    return Comparison(extra, tuple(differences), untouched)


def _pairs(own: Package, target: Package, sections: Mapping[tuple[str, str], str]) -> dict[int, int | None]:
    """Index of each of the device's sections -> that of its rendered counterpart, None without one."""
    waiting: dict[tuple[str, ...], list[int]] = {}
    for position, section in enumerate(target.sections):
        waiting.setdefault(_identity(target.name, section, section.name or ""), []).append(position)
    pairs: dict[int, int | None] = {}
    for index, section in enumerate(own.sections):
        name = sections.get((own.name, section.name or ""), section.name or "")
        candidates = waiting.get(_identity(own.name, section, name), [])
        pairs[index] = candidates.pop(0) if candidates else None
    return pairs


def _identity(package: str, section: Section, name: str) -> tuple[str, ...]:
    """The identity of a section, without its name if that is arbitrary."""
    match package, section.type:
        case ("system", "system") | ("dropbear", _) | ("dhcp", "odhcpd" | "dnsmasq") | ("firewall", "defaults"):
            return (section.type,)
        case "wireless", "wifi-device":
            return (section.type, section.get("path") or name)
        case "dhcp", "dhcp":
            return (section.type, section.get("interface") or name)
        case "firewall", "zone":
            return (section.type, *sorted(section.get("network").split()))
        case "firewall", "forwarding":
            return (section.type, section.get("src"), section.get("dest"))
        case "network", "device":
            return (section.type, section.get("name") or name)
        case "network", "route" | "route6":
            return (section.type, section.get("target"), section.get("netmask"))
        case "network", "switch":
            return (section.type, section.get("name"))
        case "network", "switch_vlan":
            return (section.type, section.get("device"), section.get("vlan"))
    return (section.type, name, *(() if name else sorted(_texts(section))))


def _texts(section: Section) -> Iterator[str]:
    return (f"{name}={_shown(name, value)}" for name, value in section.options.items())


def _options(
    package: str,
    key: str,
    own: Section,
    target: Section,
    extra: dict[str, str],
    differences: list[Difference],
) -> None:
    """The options of two paired sections."""
    for name, value in own.options.items():
        other = target.options.get(name)
        path, shown = f"{key}.{name}", _shown(name, value)
        if other is not None:
            if not _equal(package, value, other):
                differences.append(Difference(Fate.CHANGED, path, shown, _shown(name, other)))
            continue
        reason = _reason_to_drop(package, target, name, value)
        if reason:
            differences.append(Difference(Fate.REMOVED, path, shown, reason=reason))
        else:
            extra[path] = _as_text(value)
    for name, value in target.options.items():
        if name not in own.options:
            differences.append(Difference(Fate.ADDED, f"{key}.{name}", rendered=_shown(name, value)))


def _reason_to_drop(package: str, target: Section, name: str, value: Value) -> str:
    """Why an option that only the device has cannot or need not be kept; empty if it can."""
    kind = (package, target.type)
    if is_secret_option(name):
        return "a secret, which extra_uci cannot hold"
    replacement = SUPERSEDED.get(kind, {}).get(name)
    if replacement is not None:
        return f"meshctl writes {replacement} instead"
    if _as_text(value) in STOCK.get(kind, {}).get(name, ()):
        return "OpenWrt's default"
    if not isinstance(value, str) and package not in _WORD_LISTS:
        return "a list, which extra_uci cannot hold"
    return ""


def _section(
    package: str,
    key: str,
    own: Section,
    patterns: tuple[str, ...],
    extra: dict[str, str],
    differences: list[Difference],
) -> None:
    """A section that meshctl does not render."""
    if not any(fnmatchcase(key, pattern) for pattern in patterns):
        hint = "" if own.name is None else _obstacle(package, own) or f"--keep {key} keeps it"
        if (package, own.type) in _ROUTES:
            hint = "meshctl writes the routes to robots' LANs (`robots: NAME: lan`)"
        differences.append(Difference(Fate.REMOVED, key, _section_text(own), reason=hint))
        return
    obstacle = _obstacle(package, own)
    if obstacle:
        differences.append(Difference(Fate.REMOVED, key, _section_text(own), reason=obstacle))
        return
    extra[key] = own.type
    extra.update({f"{key}.{name}": _as_text(value) for name, value in own.options.items()})


def _obstacle(package: str, own: Section) -> str:
    """Why a whole section cannot be in extra_uci; empty if it can."""
    if own.name is None:
        return "extra_uci cannot hold an anonymous section"
    secret = next((name for name in own.options if is_secret_option(name)), "")
    if secret:
        return f"its {secret} is a secret, which extra_uci cannot hold"
    lists = [name for name, value in own.options.items() if not isinstance(value, str) and package not in _WORD_LISTS]
    return f"its {lists[0]} is a list, which extra_uci cannot hold" if lists else ""


def _equal(package: str, a: Value, b: Value) -> bool:
    return a == b or (package in _WORD_LISTS and _as_text(a).split() == _as_text(b).split())


def _as_text(value: Value) -> str:
    return value if isinstance(value, str) else " ".join(value)


def _shown(name: str, value: Value) -> str:
    return MASK if is_secret_option(name) else _as_text(value)


def _section_text(section: Section) -> str:
    return " ".join((section.type, *_texts(section)))
