"""Link state of a running fleet: links -> mesh graph -> each node's tables and the operator's path to each node."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from meshctl.errors import InputError
from meshlab import mesh_model
from meshlab.fleet_state import FleetState
from meshlab.shaped_tunnel import Shape
from meshlab.spec import LinkSpec, Medium, changed_link
from meshlab.state import NodeState
from meshlab.station_tables import StationTables, TrafficClass

# recomputing all tables of a big fleet is slow; at most this share of the time is spent on it
_BUSY_SHARE = 0.2


class LinkState:
    """`changed()` reports that a node or a link changed; the tables follow after the fleet's convergence time."""

    def __init__(self, fleet: FleetState) -> None:
        self._fleet = fleet
        # called after every change of what is reachable
        self.on_change: Callable[[], None] = lambda: None
        # links from the fleet's spec or its radio environment, and links that were set one by one and override them
        self._base_links = {link.ends: link for link in fleet.spec.links}
        self._overrides: dict[frozenset[str], LinkSpec] = {}
        # the parts received so far of a new set of links
        self.pending_links: list[LinkSpec] = []
        # nodes with a `sever` or `link-down` fault on all their links, and whether each was plugged in before
        self.severed: dict[str, bool] = {}
        # nodes with a `slow` fault on all their links
        self.slowed: dict[str, dict[str, Any]] = {}
        self._written: dict[str, str] = {}
        self._graph: dict[str, list[mesh_model.Edge]] = {}
        self._base_routes: dict[str, mesh_model.Route] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._stations = StationTables(TrafficClass(word) for word in fleet.spec.stale)
        # the current boot of each running node
        self._boots: dict[str, int] = {}
        # the boot in which each node last had a neighbor
        self._on_air: dict[str, int] = {}
        self._expiry: asyncio.TimerHandle | None = None
        self._last_cost_s = 0.0
        self.condition = asyncio.Condition()
        self._notices: set[asyncio.Task[None]] = set()

    def changed(self) -> None:
        """Lost paths go down now; tables and new paths follow after the convergence time."""
        self._remove_lost_routes()
        if self._timer is None:
            wait = max(self._fleet.spec.convergence_s, self._last_cost_s / _BUSY_SHARE)
            self._timer = asyncio.get_running_loop().call_later(wait, self._converge)

    def links(self) -> list[LinkSpec]:
        """Every link as it is now, with the faults of its ends."""
        return [self._with_faults(link) for link in {**self._base_links, **self._overrides}.values()]

    def _with_faults(self, link: LinkSpec) -> LinkSpec:
        if link.ends & self.severed.keys():
            link = replace(link, up=False)
        for name in link.ends & self.slowed.keys():
            link = replace(link, **self.slowed[name])
        return link

    def set_base_links(self, links: Iterable[LinkSpec]) -> None:
        """Replace all links except overrides. Links to nodes outside the fleet are ignored."""
        base_links = {link.ends: link for link in links if link.ends <= self._fleet.nodes.keys()}
        if base_links != self._base_links:
            self._base_links = base_links
            self.changed()

    def set_link(self, a: str, b: str, changes: dict[str, Any]) -> None:
        """Override a link's fields, as seen from `a`, or add the link; it stays until `restore`.

        A new `loss` applies to both directions unless `changes` has `loss_back`, and determines `tq` unless `changes`
        has `tq`. Raises InputError for an unknown node or field.
        """
        ends = frozenset((a, b))
        for name in ends:
            if name not in self._fleet.nodes:
                raise InputError(f"no node named {name} in this fleet")
        known = self._overrides.get(ends) or self._base_links.get(ends) or LinkSpec(a, b)
        try:
            self._overrides[ends] = changed_link(known.seen_from(a), changes)
        except TypeError as error:
            raise InputError(f"link {a}-{b}: {error}") from error
        self.changed()

    def restore(self, ends: frozenset[str] | None = None) -> None:
        """Remove the override of one link, or all overrides."""
        if ends is None:
            self._overrides.clear()
        else:
            self._overrides.pop(ends, None)
        self.changed()

    # -- the operator's path --

    def path_shape(self, name: str, address: str) -> Shape | None:
        """The shape of the operator's path to a node's `address`; None when there is no path."""
        state = self._fleet.nodes[name]
        if not state.is_running:
            return None
        if state.plugged and state.effective.holds(address, over="wire"):
            return Shape()
        if self._is_own_router(state) and state.effective.holds(address, over="mesh"):
            return Shape()
        path = self._base_routes.get(name)
        if path is None or not state.effective.holds(address, over="mesh"):
            return None
        if not all(self._logs_in(sender, edge) for sender, edge in path.hops):
            return None
        rates = [link.rate_kbps for link in path.links if link.rate_kbps is not None]
        arrives = 1.0
        for link in path.links:
            # TCP waits for lost segments and for lost acknowledgments alike
            arrives *= 1 - max(link.loss_to(link.a), link.loss_to(link.b))
        return Shape(
            sum(link.delay_ms for link in path.links) / 1000, 1 - arrives, min(rates) * 125.0 if rates else None
        )

    def _is_own_router(self, state: NodeState) -> bool:
        """Whether the operator's machine is on this node's LAN, which it routes: all its addresses answer there."""
        return state.spec.medium is Medium.BASE and state.plugged and state.effective.routes_lan_and_mesh

    def bench_shape(self, name: str, address: str) -> Shape | None:
        """The shape of the path over the node's bench port; None when there is none."""
        state = self._fleet.nodes[name]
        if state.is_running and state.plugged and state.effective.holds(address, over="wire"):
            return Shape()
        return None

    def reachable(self) -> set[str]:
        """The nodes with a mesh path from the base."""
        return set(self._base_routes)

    # -- station tables --

    def station_deleted(self, name: str, interface: str, mac: str) -> None:
        """The node has deleted a station from its table (`iw dev INTERFACE station del MAC`)."""
        self._stations.delete(name, interface, mac.lower(), time.time())
        self.changed()

    def _passes(self, sender: str, edge: mesh_model.Edge) -> bool:
        return self._stations.passes(sender, self._boots, edge)

    def _logs_in(self, sender: str, edge: mesh_model.Edge) -> bool:
        return self._stations.logs_in(sender, self._boots, edge)

    def _count_boots(self) -> None:
        self._boots = {name: state.boots for name, state in self._fleet.nodes.items() if state.is_running}

    def _update_stations(self) -> None:
        for name, boot in self._boots.items():
            if self._on_air.get(name, boot) != boot and not self._fleet.spec.quick_boot:
                self._stations.remove_node(name)
            if self._graph.get(name):
                self._on_air[name] = boot
        self._stations.update(self._graph, self._boots, time.time())
        if self._expiry is not None:
            self._expiry.cancel()
            self._expiry = None
        due_s = self._stations.next_change_s()
        if due_s is not None:
            wait_s = max(1.0, due_s - time.time() + 0.1)
            self._expiry = asyncio.get_running_loop().call_later(wait_s, self.changed)

    def _station_rows(self, name: str) -> list[mesh_model.StationRow]:
        return [
            mesh_model.StationRow(
                entry.holder.interface,
                entry.mac,
                entry.signal_dbm,
                entry.tq,
                int(entry.since_s),
                int(entry.silent_since_s or 0),
            )
            for entry in self._stations.entries_of(name)
        ]

    # -- computing --

    def _nodes(self) -> dict[str, mesh_model.EffectiveState]:
        return {name: state.effective for name, state in self._fleet.nodes.items() if state.effective.interfaces}

    def _routes_from_base(self, graph: dict[str, list[mesh_model.Edge]]) -> dict[str, mesh_model.Route]:
        found: dict[str, mesh_model.Route] = {}
        for name, state in self._fleet.nodes.items():
            if state.spec.medium is not Medium.BASE or not state.plugged:
                continue
            bridges = state.effective.bridges_lan_and_mesh
            if not bridges and not state.effective.routes_lan_and_mesh:
                continue
            for target, path in mesh_model.best_routes(graph, name).items():
                if not bridges and not self._fleet.nodes[target].effective.answers_through(state.effective):
                    continue
                if target not in found or path.tq > found[target].tq:
                    found[target] = path
        return found

    def _remove_lost_routes(self) -> None:
        """Drop the routes that no longer exist; new ones wait for `_converge`."""
        self._count_boots()
        now = self._routes_from_base(mesh_model.edges(self._nodes(), self.links()))
        self._base_routes = {name: path for name, path in now.items() if name in self._base_routes}
        self._notify()

    def _converge(self) -> None:
        loop = asyncio.get_running_loop()
        started = loop.time()
        self._timer = None
        self._count_boots()
        nodes = self._nodes()
        self._graph = mesh_model.edges(nodes, self.links())
        self._base_routes = self._routes_from_base(self._graph)
        self._update_stations()
        hung = frozenset(name for name, state in self._fleet.nodes.items() if state.hung)
        for name, state in self._fleet.nodes.items():
            routes = mesh_model.best_routes(self._graph, name) if name in nodes else {}
            text = mesh_model.heard_text(name, nodes, self._graph, routes, self._station_rows(name), self._passes)
            text += mesh_model.servers_text(name, nodes, self._graph, self._logs_in, hung)
            if self._written.get(name) != text:
                self._written[name] = text
                _replace(state.home / "air" / "heard", text)
        self._last_cost_s = loop.time() - started
        self._notify()

    def _notify(self) -> None:
        self.on_change()

        async def notify() -> None:
            async with self.condition:
                self.condition.notify_all()

        notice = asyncio.ensure_future(notify())
        self._notices.add(notice)
        notice.add_done_callback(self._notices.discard)


def _replace(path: Path, text: str) -> None:
    new = path.with_name("heard.new")
    new.write_text(text, encoding="ascii")
    new.replace(path)
