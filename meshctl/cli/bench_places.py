"""Where devices are on a bench, and which are expected there: the options `--at`, `--interface` and `--at-site`."""

from __future__ import annotations

import socket
from dataclasses import replace
from ipaddress import ip_address
from typing import Annotated

import typer

from meshctl.apply.bootstrap import FACTORY_ADDRESS, BenchTarget
from meshctl.cli.extensions import LabFleet
from meshctl.cli.node_completion import complete_nodes
from meshctl.errors import InputError
from meshctl.model import Fleet, Node
from meshctl.suggest import did_you_mean

ExpectedNodes = Annotated[
    list[str] | None,
    typer.Argument(
        help="Expected nodes: names, labels, serial numbers, MACs, patterns, groups; default: identify by MAC.",
        autocompletion=complete_nodes,
    ),
]

At = Annotated[
    list[str] | None,
    typer.Option(
        "--at",
        metavar="HOST",
        help="Address of a device, HOST or HOST:PORT, e.g. fe80::1%eth2 (in a lab a virtual node); one per NODE, in "
        "the same order.",
    ),
]

Interfaces = Annotated[
    list[str] | None,
    typer.Option(
        "--interface",
        metavar="IF",
        help="Interface with one factory-default device, e.g. eth1; one per NODE, in the same order.",
    ),
]

AtSite = Annotated[
    str,
    typer.Option(
        "--at-site", metavar="SITE", help="The devices are on the bench of this site's gateway, not on your own."
    ),
]


def with_site(fleet: Fleet, place: BenchTarget, site: str) -> BenchTarget:
    """This place on the bench of a site's gateway, if there is a site. Raises InputError."""
    if not site:
        return place
    if site not in fleet.sites:
        hint = did_you_mean(site, fleet.sites) or f"its sites are {', '.join(fleet.sites) or 'none'}"
        raise InputError(f"--at-site {site}: {fleet.name} has no such site", hint=hint)
    if not fleet.sites[site].has_gateway:
        raise InputError(f"--at-site {site}: the site has no login", hint=f"set sites.{site}.ssh.host")
    return replace(place, site=site)


def no_answer_hint(place: BenchTarget, node: Node | None, *, is_pinned: bool, is_unfinished: bool = False) -> str:
    """The probable reason why nothing answers at a place, and its remedy; empty at an address that the operator gave.

    `node` is expected there; `is_pinned` if it has a host key, as since its first bootstrap; `is_unfinished` if a run
    left a change of it whose end is not known.
    """
    if node is not None and is_unfinished:
        return (
            f"the last run left its change of {node.name} unconfirmed, so {node.name} undoes it and restarts its "
            "network: try again in a few minutes"
        )
    if node is not None and is_pinned:
        return (
            f"{node.name} has a pinned host key, so it is probably set up already and answers at {node.address.ip} "
            f"instead: check with `meshctl status {node.name}`; to set it up again, reset it to factory defaults and "
            "pass --replace-key"
        )
    if place.host != FACTORY_ADDRESS or place.site:
        return ""
    return (
        f"check that it has booted and that this machine has an address in the network of {FACTORY_ADDRESS}; "
        "if another device had this address a moment ago, try again: this machine still sends to that one; "
        "a device that is set up already answers at its address in the inventory instead"
    )


def named_places(at: list[str], interfaces: list[str], site: str) -> list[BenchTarget]:
    """The bench places given by --at or --interface."""
    if interfaces and site:
        raise InputError("--interface is one of this computer, and --at-site says that the device is elsewhere")
    if at and interfaces:
        raise InputError("expected --at or --interface, found both")
    if doubles := sorted({name for name in interfaces if interfaces.count(name) > 1}):
        raise InputError(f"--interface {doubles[0]} is given twice: expected one device per interface")
    known = {name for _, name in socket.if_nameindex()}
    for name in interfaces:
        if name not in known:
            raise InputError(f"--interface {name}: no such interface, found {', '.join(sorted(known))}")
    return [_parse_place(text) for text in at] + [BenchTarget(interface=name) for name in interfaces]


def places_in_lab(places: list[BenchTarget], lab: LabFleet) -> list[BenchTarget]:
    """The ports of virtual nodes. A practice run must not reach the devices on a real bench. Raises InputError."""
    return [_place_in_lab(place, lab) for place in places]


def _place_in_lab(place: BenchTarget, lab: LabFleet) -> BenchTarget:
    names = lab.node_names
    if place.host in names and not place.interface:
        end = lab.bench_endpoint(place.host)
        return replace(place, host=end.host, port=end.port)
    if place.interface or not _is_loopback(place.host):
        given = f"--interface {place.interface}" if place.interface else f"--at {place.host}"
        raise InputError(
            f"{given} is not in the lab: expected a virtual node that is plugged in",
            hint=did_you_mean(place.host, names) or f"for example: --at {names[-1]}",
        )
    return place


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def _parse_place(text: str) -> BenchTarget:
    """Parse `HOST`, `HOST:PORT` or `[IPv6]:PORT`; a bare IPv6 address has no port."""
    host, colon, port = text.rpartition(":")
    if not colon or (text.count(":") > 1 and not text.startswith("[")):
        return BenchTarget(text)
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"--at {text}: expected HOST or HOST:PORT")
    return BenchTarget(host.strip("[]"), int(port))
