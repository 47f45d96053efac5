"""Link state of a QEMU fleet: links -> hwsim groups and traffic control in the kernel.

Links and power changes set the hwsim groups; losses, delays and rates become traffic control on the receiving node
(`traffic_control`). Tables and routes are batman-adv's own. Cables are connected here, too, because `changed()` also
reports that a node was plugged in or unplugged.
"""

from __future__ import annotations

import asyncio
import logging

from meshlab import hwsim_groups
from meshlab.errors import LabError
from meshlab.fleet_state import FleetState
from meshlab.link_state import LinkState
from meshlab.qemu import hwsim_devices, traffic_control
from meshlab.quality import loss_of
from meshlab.shaped_tunnel import Shape
from meshlab.spec import Medium
from meshlab.state import NodeState

log = logging.getLogger("meshlab.qemu.link_state")
# after a change could not be applied to a running node
_RETRY_S = 1.0
# Real radios raise their interrupts at different moments, hwsim's in the same one. Two radios on a switch would always
# both claim a broadcast's sender for their LAN, and then leave it to each other: a claim takes less (docs/lab.md).
_LAG_MS = 5.0


class QemuLinkState(LinkState):
    """`hardware` has each node's devices in the machine."""

    def __init__(self, fleet: FleetState, hardware: dict[str, hwsim_devices.NodeHardware]) -> None:
        super().__init__(fleet)
        self._hardware = hardware
        self._groups: dict[str, int] = {}
        self._cabled: dict[str, tuple[int, bool]] = {}
        self._impaired: dict[str, tuple[int, str]] = {}

    # -- groups, cables and impairments --

    def _remove_lost_routes(self) -> None:
        """Silence a node without power now; the kernel removes its interfaces a little later."""
        off = [name for name, state in self._fleet.nodes.items() if not state.is_running and self._groups.get(name)]
        if off:
            self.set_groups(dict.fromkeys(off, 0))

    def _converge(self) -> None:
        self._timer = None
        links = [link for link in self.links() if link.up and min(link.loss_to(link.a), link.loss_to(link.b)) < 1.0]
        running = {name for name, state in self._fleet.nodes.items() if state.is_running}
        edges = [(link.a, link.b) for link in links if link.ends <= running]
        self.set_groups(hwsim_groups.assign(list(self._fleet.nodes), edges))
        for state in self._fleet.nodes.values():
            try:
                self._connect_cable(state)
                self._impair_node(state)
            except LabError as error:
                # a node that is ending removes its devices; one that is reconfiguring recreates them
                log.warning("not-applied node=%s reason=%s", state.spec.name, error)
                if state.is_running:
                    asyncio.get_running_loop().call_later(_RETRY_S, self.changed)
        self._notify()

    def set_groups(self, masks: dict[str, int]) -> None:
        """Write radios' group masks in an order that links no other radios meanwhile."""
        for name, mask in hwsim_groups.transition(self._groups, masks):
            for phy in self._hardware[name].phys:
                hwsim_devices.set_group(phy, mask)
            self._groups[name] = mask

    def _connect_cable(self, state: NodeState) -> None:
        if state.pid <= 0:
            return
        hardware = self._hardware[state.spec.name]
        on_bench = state.plugged and not hwsim_devices.is_on_operator_lan(hardware, self._fleet.spec)
        cabled = (state.boots, on_bench)
        if self._cabled.get(state.spec.name) != cabled:
            hwsim_devices.connect_cable(hardware, self._fleet.spec, on_bench=on_bench)
            self._cabled[state.spec.name] = cabled

    def _impair_node(self, state: NodeState) -> None:
        """Set the impairments of everything that this node's radios receive."""
        if state.pid <= 0:
            return
        name = state.spec.name
        heard = {}
        for link in self.links():
            if name not in link.ends or not link.up:
                continue
            other = link.b if name == link.a else link.a
            # a TQ limit is implemented as the loss that leads to it
            loss = max(link.loss_to(name), loss_of(link.tq))
            delay_ms = link.delay_ms + self._lag_ms(name)
            impairment = traffic_control.Impairment(loss, delay_ms, link.rate_kbps, link.broadcast_kbps)
            if not impairment.is_none:
                heard.update({cell.mac: impairment for cell in self._fleet.nodes[other].effective.interfaces})
        self.impair(state, heard)

    def _lag_ms(self, name: str) -> float:
        """How much later this node hears than the first one on its LAN."""
        lans = (lan for lan in self._fleet.spec.lans if name in lan.nodes)
        return next((_LAG_MS * lan.nodes.index(name) for lan in lans), 0.0)

    def impair(self, state: NodeState, heard: dict[str, traffic_control.Impairment]) -> None:
        """Apply impairments, by the sender's MAC, on every radio interface of the node that is up."""
        batch = "".join(traffic_control.batch(cell.interface, heard) for cell in state.effective.interfaces)
        impaired = (state.boots, batch)
        if self._impaired.get(state.spec.name, (state.boots, "")) == impaired:
            return
        for cell in state.effective.interfaces:
            traffic_control.clear(state.pid, cell.interface)
            if heard:
                traffic_control.apply(state.pid, cell.interface, traffic_control.batch(cell.interface, heard))
        self._impaired[state.spec.name] = impaired

    def reset_impairments(self, name: str) -> None:
        """The node has reconfigured its interfaces, which removed their traffic control."""
        self._impaired[name] = (self._fleet.nodes[name].boots, "?")

    # -- the operator's path --

    def path_shape(self, name: str, address: str) -> Shape | None:
        """An unrestricted shape if the address may be reachable; the kernel decides when a connection is made."""
        state = self._fleet.nodes[name]
        if not state.is_running:
            return None
        if self.bench_shape(name, address) is not None:
            return Shape()
        return Shape() if state.effective.holds(address, over="mesh") else None

    def reachable(self) -> set[str]:
        """The nodes to which the base's batman-adv has a route."""
        of_mac = {
            cell.mac: name
            for name, state in self._fleet.nodes.items()
            for cell in state.effective.interfaces
            if state.pid
        }
        found: set[str] = set()
        for state in self._fleet.nodes.values():
            if self._is_base(state) and state.pid > 0 and state.effective.interfaces:
                found.add(state.spec.name)
                found.update(of_mac[mac] for mac in traffic_control.originators(state.pid) if mac in of_mac)
        return found

    def _is_base(self, state: NodeState) -> bool:
        return state.spec.medium is Medium.BASE
