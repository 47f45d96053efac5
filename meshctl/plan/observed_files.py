"""Read the planned files and the mesh state from an observation.

Paths have no leading slash (`etc/config/network`), as in rendered files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from ipaddress import ip_address

from meshctl.device.observation import FileInfo, Observation
from meshctl.diagnostics import InvalidInput
from meshctl.model.ip import IpAddress
from meshctl.plan.cell import Cell
from meshctl.topology import NEIGHBOR_FRESH_MS
from meshctl.uci import Package, Section, parse

CONFIG = "etc/config/"
WIRELESS = f"{CONFIG}wireless"


def package_of(path: str) -> str | None:
    """The UCI package at a path, or None."""
    return path.removeprefix(CONFIG) if path.startswith(CONFIG) else None


def text_of(path: str, observation: Observation) -> str | None:
    """A file's text on the node; None when it is missing or not text."""
    package = package_of(path)
    if package is not None:
        return (observation.uci or {}).get(package)
    info = file_info(path, observation)
    return None if info is None else info.text


def file_info(path: str, observation: Observation) -> FileInfo | None:
    """The file's mode, hash and text, if it was requested by path."""
    return observation.files.get(f"/{path}") or observation.files.get(path)


def packages_seen(paths: Iterable[str], observation: Observation) -> dict[str, Package | None]:
    """The UCI packages among these paths as trees; None for one that is missing or not readable as UCI."""
    found: dict[str, Package | None] = {}
    for path in paths:
        package = package_of(path)
        if package is not None:
            found[package] = parsed(text_of(path, observation), package)
    return found


def parsed(text: str | None, package: str) -> Package | None:
    """A package's tree, or None if it is missing or unreadable."""
    return None if text is None else _parsed(text, package)


# A plan reads the same file several times, many nodes have the same dhcp or firewall file, and the next round of
# `status --watch` finds most files unchanged: enough for those of 200 nodes.
@lru_cache(maxsize=2048)
def _parsed(text: str, package: str) -> Package | None:
    try:
        return parse(text, package)
    except InvalidInput:
        return None


def management_section(network: Package) -> Section | None:
    """The interface with the management address: a router's on the mesh, else `lan`."""
    return network.section("backbone") or network.section("lan")


def address_options(section: Section | None) -> tuple[str, ...]:
    """The addresses of an interface section without prefix lengths, as written: IPv4, then IPv6.

    Both options may be lists (netifd's `proto_static`).
    """
    if section is None:
        return ()
    written = (*section.items("ipaddr"), *section.items("ip6addr"))
    return tuple(bare for text in written for word in text.split() if (bare := word.partition("/")[0]))


def management_address(network: str | None) -> IpAddress | None:
    """The management address in a network file; None if it has none that is an address, is missing or unreadable."""
    tree = parsed(network, "network")
    for text in () if tree is None else address_options(management_section(tree)):
        try:
            return ip_address(text)
        except ValueError:
            continue
    return None


def fingerprint_texts(paths: Iterable[str], observation: Observation) -> dict[str, str]:
    """Everything a plan depends on, by name: if any of it differs later, the plan is stale."""
    texts = {
        f"file {path}": "missing" if (text := text_of(path, observation)) is None else f"text {text}" for path in paths
    }
    for path in paths:
        info = file_info(path, observation)
        if info is not None:
            texts[f"mode {path}"] = f"{info.mode:o} {info.sha256}"
    texts["board"] = observation.board.board_name if observation.board else "?"
    texts["revision"] = observation.release.revision if observation.release else "?"
    return texts


def is_meshed(observation: Observation, live: Mapping[str, Cell]) -> bool:
    """Whether the node is part of a running mesh: a radio in a cell, and a neighbor heard recently or unknown."""
    if not live:
        return False
    if observation.neighbors is not None:
        return any(neighbor.last_seen_ms <= NEIGHBOR_FRESH_MS for neighbor in observation.neighbors)
    return observation.stations is None or bool(observation.stations)
