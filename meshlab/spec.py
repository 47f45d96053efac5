"""The spec of a virtual fleet: nodes, radios and links, as frozen values that convert to JSON and back without loss.

A spec comes from an inventory (`from_inventory.spec_of`) or a test; the supervisor reads it from the fleet's directory.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import Enum
from typing import Any

from meshctl.errors import InputError
from meshctl.model import Release
from meshlab.quality import TQ_MAX, tq_of

# the packages an image needs for an encrypted mesh (openwrt-facts.md section 10)
MESH_PACKAGES = ("kmod-batman-adv", "batctl-default", "wpad-openssl")


class Medium(Enum):
    """How the operator's machine is wired to a node's LAN port."""

    # not wired: reached only over the mesh
    NONE = "none"
    # on the bench: its LAN port is connected to the operator's machine, whatever its address
    BENCH = "bench"
    # the base: the operator's machine is on its LAN, and reaches the mesh through it
    BASE = "base"


# it supports both modes of a mesh
DEFAULT_DRIVER = "ath9k"

# of a factory-fresh device
SSH_PORT = 22


@dataclass(frozen=True, slots=True)
class RadioSpec:
    """One radio of the board: UCI section, device path in the kernel, band (`2g` or `5g`), MAC address, driver by its
    name in OpenWrt."""

    name: str = "radio0"
    path: str = "platform/ahb/18100000.wmac"
    band: str = "2g"
    mac: str = ""
    max_tx_power_dbm: int = 27
    driver: str = DEFAULT_DRIVER


@dataclass(frozen=True, slots=True)
class NodeSpec:
    """One factory-fresh node: factory image, factory address 192.168.1.1, no password.

    `release` is the series; `releases` has its revision and kernel. `packages` are built into its image besides the
    release's own. `mac` is the label's address, on the first LAN port; radios without one get `mac` + 1, ...
    `overlay_kib` is the flash left for changes, `memory_kib` the RAM. `host_key_types` None: the release's defaults
    (19.07 RSA, later RSA and ed25519); `("ed25519",)` makes big fleets start faster. `flash_s` is the time to write an
    image, `first_boot_s` the time from the first login to the last init script at the boot after that. `slowness` is
    how many times longer than on a fast machine reloads of services and radios, and writing to flash, take. `ssh_port`
    is where the inventory has its SSH server, which is reached there and, as the factory has it, at 22.
    """

    name: str
    board: str = "compex,wpj344-16m"
    model: str = "Compex WPJ344 (16MB flash)"
    target: str = "ath79/generic"
    release: Release = Release.V23_05
    packages: tuple[str, ...] = MESH_PACKAGES
    radios: tuple[RadioSpec, ...] = (RadioSpec(),)
    lan_ports: tuple[str, ...] = ("eth0",)
    mac: str = ""
    medium: Medium = Medium.BENCH
    overlay_kib: int = 8192
    memory_kib: int = 128 * 1024
    host_key_types: tuple[str, ...] | None = None
    flash_s: float = 1.0
    first_boot_s: float = 1.0
    slowness: int = 1
    ssh_port: int = SSH_PORT

    @property
    def ssh_ports(self) -> tuple[int, ...]:
        """The ports of its SSH server that are forwarded, in the order in which they are tried."""
        return tuple(dict.fromkeys((self.ssh_port, SSH_PORT)))


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """Two nodes that can hear each other while their radios share a cell.

    `loss` is the share (0..1) of frames from `a` that `b` loses, `loss_back` that of frames from `b` (None: the same);
    1.0: no frame arrives. `signal_dbm` is the signal of `a` at `b`, `signal_back_dbm` that of `b` at `a` (None: the
    same). `tq` limits batman-adv's quality (0..255) of the link; losses lower it. `delay_ms` is one way; `rate_kbps`
    None: unlimited. `broadcast_kbps` is the rate of broadcasts on a link with a rate (None: the same).
    """

    a: str
    b: str
    tq: int = TQ_MAX
    signal_dbm: int = -58
    delay_ms: float = 0.0
    loss: float = 0.0
    rate_kbps: int | None = None
    up: bool = True
    loss_back: float | None = None
    signal_back_dbm: int | None = None
    broadcast_kbps: int | None = None

    @property
    def ends(self) -> frozenset[str]:
        return frozenset((self.a, self.b))

    def loss_to(self, name: str) -> float:
        """The share of the other end's frames that the end `name` loses."""
        return self.loss if name == self.b or self.loss_back is None else self.loss_back

    def signal_at(self, name: str) -> int:
        """The other end's signal at the end `name`, in dBm."""
        return self.signal_dbm if name == self.b or self.signal_back_dbm is None else self.signal_back_dbm

    def tq_to(self, name: str) -> int:
        """batman-adv's quality (0..255) of sending over this link to the end `name`."""
        there = self.loss_to(name)
        back = self.loss_to(self.a if name == self.b else self.b)
        return min(self.tq, tq_of(there, back))

    def seen_from(self, name: str) -> LinkSpec:
        """The same link with the end `name` as its `a`."""
        if name == self.a:
            return self
        loss, signal_dbm = self.loss_to(self.a), self.signal_at(self.a)
        back = None if self.loss_back is None else self.loss
        signal_back_dbm = None if self.signal_back_dbm is None else self.signal_dbm
        return replace(
            self, a=self.b, b=self.a, loss=loss, signal_dbm=signal_dbm, loss_back=back, signal_back_dbm=signal_back_dbm
        )


def changed_link(link: LinkSpec, changes: Mapping[str, Any]) -> LinkSpec:
    """The link with changed fields, as seen from its `a`; `loss_to_b` is the loss in that direction only.

    A new loss determines the quality: `tq` no longer limits it, unless `changes` has `tq`. A new `loss` applies to both
    directions unless `changes` has `loss_back`. Raises TypeError for an unknown field.
    """
    fields = dict(changes)
    if "loss_to_b" in fields:
        fields = {"loss_back": link.loss_to(link.a), **fields, "loss": fields["loss_to_b"]}
        del fields["loss_to_b"]
    if "loss" in fields:
        fields = {"tq": TQ_MAX, "loss_back": None, **fields}
    return replace(link, **fields)


@dataclass(frozen=True, slots=True)
class LanSpec:
    """A robot's wired network: one switch, the LAN ports of `nodes`, and its computer with an address such as
    `10.42.0.21/24` and a default gateway, if set. Only QEMU fleets have LANs."""

    name: str
    nodes: tuple[str, ...]
    computer: str = ""
    gateway: str = ""


@dataclass(frozen=True, slots=True)
class FleetSpec:
    """A whole fleet. `port` is the TCP port of all its loopback addresses (`addresses.loopback_of`).

    0 lets the supervisor choose a free one, which `VirtualFleet.port` returns. `seed` seeds the random start-up times
    of services and radios. A virtual node boots in a second, a real one takes about as long as neighbors keep the entry
    of a silent station; with `quick_boot` they keep it over a boot, as after a real boot within a minute. `stale`: the
    traffic classes that a stale station entry drops (`station_tables.TrafficClass`).
    """

    name: str
    nodes: tuple[NodeSpec, ...]
    links: tuple[LinkSpec, ...] = ()
    port: int = 0
    # the time until batman-adv knows a new link; real meshes need 10 to 20 s
    convergence_s: float = 0.2
    lans: tuple[LanSpec, ...] = ()
    seed: int = 0
    quick_boot: bool = False
    stale: tuple[str, ...] = ("ordinary", "logins")

    def __post_init__(self) -> None:
        names = [node.name for node in self.nodes]
        doubles = sorted({name for name in names if names.count(name) > 1})
        if doubles:
            raise InputError(f"lab fleet {self.name}: expected unique node names, found twice: {', '.join(doubles)}")
        for link in self.links:
            for end in (link.a, link.b):
                if end not in names:
                    raise InputError(f"lab fleet {self.name}: link {link.a}-{link.b}: no node named {end}")

    def node(self, name: str) -> NodeSpec:
        for node in self.nodes:
            if node.name == name:
                return node
        raise InputError(f"lab fleet {self.name}: no node named {name}", hint=f"nodes: {', '.join(self.names)}")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(node.name for node in self.nodes)


def dump(spec: FleetSpec) -> str:
    """The spec as JSON text."""

    def plain(value: Any) -> Any:
        return value.value if isinstance(value, Enum) else value

    return json.dumps(asdict(spec, dict_factory=lambda items: {key: plain(value) for key, value in items}), indent=1)


def load(text: str) -> FleetSpec:
    """Read a spec that `dump` wrote. Raises InputError when another version of meshctl wrote it."""
    try:
        return _loaded(json.loads(text))
    except (KeyError, TypeError, ValueError) as error:
        found = f"nothing under {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"spec.json of the lab's fleet: expected the format of this version of meshctl, found {found}",
            hint="another version started the fleet: run `meshctl lab down`, then `meshctl lab up`",
        ) from error


def _loaded(data: dict[str, Any]) -> FleetSpec:
    nodes = tuple(
        NodeSpec(
            **{
                **node,
                "release": Release(node["release"]),
                "medium": Medium(node["medium"]),
                "packages": tuple(node["packages"]),
                "lan_ports": tuple(node["lan_ports"]),
                "radios": tuple(RadioSpec(**radio) for radio in node["radios"]),
                "host_key_types": None if node["host_key_types"] is None else tuple(node["host_key_types"]),
            }
        )
        for node in data.pop("nodes")
    )
    links = tuple(LinkSpec(**link) for link in data.pop("links"))
    lans = tuple(LanSpec(**{**lan, "nodes": tuple(lan["nodes"])}) for lan in data.pop("lans"))
    return FleetSpec(nodes=nodes, links=links, lans=lans, stale=tuple(data.pop("stale")), **data)
