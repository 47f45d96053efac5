"""The air of a fleet of real radios: links -> hwsim's groups, and what is lost on its way, in the kernel.

A link that is up, or a node that gets power, changes the groups; losses, delays and rates become traffic control on the
node that hears (`losses`). Nobody computes tables or paths here: batman-adv does. Cables are laid here, too, because
`changed()` is also how the supervisor says that a node was plugged in or pulled out.
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
# after something could not be applied to a node that goes on running
_RETRY_S = 1.0


class QemuLinkState(LinkState):
    """`places` tells where each node's hardware is."""

    def __init__(self, fleet: FleetState, hardware: dict[str, hwsim_devices.NodeHardware]) -> None:
        super().__init__(fleet)
        self._hardware = hardware
        self._groups: dict[str, int] = {}
        self._cabled: dict[str, tuple[int, bool]] = {}
        self._impaired: dict[str, tuple[int, str]] = {}

    # -- what holds now --

    def _remove_lost_routes(self) -> None:
        """A node without power is silent at once; the kernel takes its interfaces apart a little later."""
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
                # a node that ends in this moment takes its devices with it, one that configures them makes them again
                log.warning("not-applied node=%s reason=%s", state.spec.name, error)
                if state.is_running:
                    asyncio.get_running_loop().call_later(_RETRY_S, self.changed)
        self._notify()

    def set_groups(self, masks: dict[str, int]) -> None:
        """Give nodes' radios their masks, in an order in which nobody hears whom it should not."""
        for name, mask in hwsim_groups.transition(self._groups, masks):
            for phy in self._hardware[name].phys:
                hwsim_devices.set_group(phy, mask)
            self._groups[name] = mask

    def _connect_cable(self, state: NodeState) -> None:
        if state.pid <= 0:
            return
        on_bench = state.plugged and not self._is_base(state)
        wanted = (state.boots, on_bench)
        if self._cabled.get(state.spec.name) != wanted:
            hwsim_devices.connect_cable(self._hardware[state.spec.name], self._fleet.spec, on_bench=on_bench)
            self._cabled[state.spec.name] = wanted

    def _impair_node(self, state: NodeState) -> None:
        """What this node's radios do not hear of what they could hear."""
        if state.pid <= 0:
            return
        name = state.spec.name
        heard = {}
        for link in self.links():
            if name not in link.ends or not link.up:
                continue
            other = link.b if name == link.a else link.a
            # a quality given by hand is what losses of that size make of a link
            loss = max(link.loss_to(name), loss_of(link.tq))
            impairment = traffic_control.Impairment(loss, link.delay_ms, link.rate_kbps)
            if not impairment.is_none:
                heard.update({cell.mac: impairment for cell in self._fleet.nodes[other].effective.interfaces})
        self.impair(state, heard)

    def impair(self, state: NodeState, heard: dict[str, traffic_control.Impairment]) -> None:
        """Make it so on every radio interface of the node that is up."""
        batch = "".join(traffic_control.batch(cell.interface, heard) for cell in state.effective.interfaces)
        wanted = (state.boots, batch)
        if self._impaired.get(state.spec.name, (state.boots, "")) == wanted:
            return
        for cell in state.effective.interfaces:
            traffic_control.clear(state.pid, cell.interface)
            if heard:
                traffic_control.apply(state.pid, cell.interface, traffic_control.batch(cell.interface, heard))
        self._impaired[state.spec.name] = wanted

    def reset_impairments(self, name: str) -> None:
        """The node has configured its interfaces anew: what was done to them is gone."""
        self._impaired[name] = (self._fleet.nodes[name].boots, "?")

    # -- the way to the operator --

    def path_shape(self, name: str, address: str) -> Shape | None:
        """Whether a door may stand there; where it leads, the kernel finds out when somebody enters."""
        state = self._fleet.nodes[name]
        if not state.is_running:
            return None
        if self.bench_shape(name, address) is not None:
            return Shape()
        return Shape() if state.effective.holds(address, over="mesh") else None

    def reachable(self) -> set[str]:
        """The nodes that the base's batman-adv has a route to at this moment."""
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
