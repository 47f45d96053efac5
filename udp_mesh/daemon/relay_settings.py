"""The relay keys of the configuration file: whom this daemon passes datagrams on for, over how many links, under what
key."""

from __future__ import annotations

from udp_mesh.core.settings import RelaySettings
from udp_mesh.crypto import Key
from udp_mesh.daemon.neighbours import NODE_NAME, is_node_name
from udp_mesh.daemon.toml_source import Table
from udp_mesh.wire.limits import MAX_RELAY_HOPS

ALL = "all"
"""In `relay`: pass datagrams on for every node."""


def read_relay(top: Table, keys: tuple[Key, ...]) -> RelaySettings:
    """`relay`, a list of names (`["all"]`: every node), and `relay_hops`; `keys` are those of `relay_key_file`."""
    names = top.texts("relay")
    hops = top.integer("relay_hops", RelaySettings().hops, 1, MAX_RELAY_HOPS) or RelaySettings().hops
    for name in names:
        if not is_node_name(name):
            top.report("relay", NODE_NAME, name)
    if top.source.problems:
        return RelaySettings()
    if names and hops == 1:
        top.report("relay_hops", "at least 2 beside relay", "1")
        return RelaySettings()
    return RelaySettings(tuple(name for name in names if name != ALL), ALL in names, hops, keys)
