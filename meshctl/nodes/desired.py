"""The desired state of each node: the inventory, rendered with facts only the device has."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from meshctl.device.observation import Observation
from meshctl.model import Fleet, Node, Secret, SecretRef
from meshctl.plan import DesiredState
from meshctl.plan.observed_files import packages_seen
from meshctl.plan.packages import Needs
from meshctl.render import DeviceFacts, Rendered, Templates, render, with_switch
from meshctl.resolve import Intent, package_files, package_needs, resolve


@dataclass(frozen=True, slots=True)
class Renderer:
    """Renders the nodes of one fleet; `secrets` resolves its secret references."""

    fleet: Fleet
    secrets: Callable[[SecretRef], Secret]
    templates: Templates
    # node -> its intent and files without facts of the device
    _plain: dict[str, tuple[Node, Intent, Rendered]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @classmethod
    def of(cls, fleet: Fleet, secrets: Callable[[SecretRef], Secret]) -> Renderer:
        return cls(fleet, secrets, Templates.of(fleet))

    def desired(self, node: Node, observation: Observation | None = None) -> DesiredState:
        """One node's files and packages. Raises InvalidInput for values that cannot be rendered."""
        intent, plain = self._rendered(node)
        rendered = (
            plain
            if observation is None
            else render(intent, self.templates, device_facts(node, observation), plain=plain)
        )
        return DesiredState(
            node,
            rendered.files,
            tuple(secret.reveal() for secret in intent.secrets),
            Needs(_groups(self.fleet, node, rendered.packages), rendered.removed_packages),
            package_files=package_files(self.fleet, node),
        )

    def _rendered(self, node: Node) -> tuple[Intent, Rendered]:
        """The node's intent and its files without facts of the device, rendered once."""
        known = self._plain.get(node.name)
        if known is None or known[0] is not node:
            intent = resolve(self.fleet, node, self.secrets)
            known = self._plain[node.name] = (node, intent, render(intent, self.templates))
        return known[1], known[2]


def device_facts(node: Node, observation: Observation | None) -> DeviceFacts:
    """The facts to keep from the device (`meshctl.render.facts`).

    Where its ports are VLANs of a switch (eth0.1) that its configuration no longer defines, the board's are used.
    """
    if observation is None:
        return DeviceFacts()
    paths = ("etc/config/network", "etc/config/system", "etc/config/wireless")
    packages = {name: package for name, package in packages_seen(paths, observation).items() if package is not None}
    if "network" in packages and observation.board is not None and any("." in port for port in node.lan_ports):
        packages["network"] = with_switch(packages["network"], observation.board.switch_vlans)
    sections = packages["system"].of_type("system") if "system" in packages else ()
    return DeviceFacts(next((text for section in sections if (text := section.get("compat_version"))), ""), packages)


def _groups(fleet: Fleet, node: Node, packages: Iterable[str]) -> tuple[tuple[str, ...], ...]:
    """Each package to install, with its alternatives (`batctl-full` for `batctl-default`)."""
    needs = package_needs(fleet, node)
    chosen = [
        next(((name, *(o for o in need.any_of if o != name)) for need in needs if name in need.any_of), (name,))
        for name in packages
    ]
    return tuple(chosen)
