"""Fleet -> one node's Intent: group meshes by routing interface, build the bridge, select intervals.

A radio in a mesh gets the interface `mesh0`, `mesh1`, ... in the radios' order. Meshes with the same network and
routing algorithm share one batman-adv interface (`bat0`), so that a node with several radios routes between them; any
other mesh gets its own interface, which relays but is not bridged. The bridge connects the wired ports to the routing
interface of the mesh whose network contains the node's address. A node with an address in its robot's own LAN is a
router instead: the bridge has the wired ports only, and the routing interface has the management address.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

from meshctl.diagnostics import Diagnostic, InvalidInput
from meshctl.errors import InputError
from meshctl.model import Backend, Encryption, Fleet, Mesh, Node, OperatorParts, Radio, Secret, SecretRef
from meshctl.model.ip import IpNetwork
from meshctl.resolve.intent import (
    Backbone,
    BatmanInterface,
    Intent,
    Lan,
    LanFilterIntent,
    Login,
    MeshInterface,
    RadioIntent,
)
from meshctl.resolve.intervals import Intervals, UnreachableTarget, batman_intervals
from meshctl.resolve.packages import package_plan
from meshctl.resolve.refusals import COMBINATION, RECONNECT, SECRET, ValueChecks
from meshctl.resolve.routes import routes

BRIDGE = "br-lan"
# dropbear's own default
SSH_PORT = 22


def resolve(fleet: Fleet, node: Node, secrets: Callable[[SecretRef], Secret]) -> Intent:
    """The desired configuration of `node`.

    Raises InvalidInput with all values that the node's files cannot contain (docs/render.md).
    """
    intent, found = resolve_unchecked(fleet, node, secrets)
    if found:
        raise InvalidInput(found)
    return intent


def resolve_unchecked(
    fleet: Fleet, node: Node, secrets: Callable[[SecretRef], Secret]
) -> tuple[Intent, tuple[Diagnostic, ...]]:
    """The configuration of `node` as written, with all values that its files cannot contain: for lint, never for a
    node."""
    checks = ValueChecks(fleet)
    meshes = tuple(fleet.meshes[name] for name in node.meshes)
    primary = _primary(meshes, node)
    keys = _keys(meshes, node, secrets, checks)
    masters = _masters(meshes)
    intervals = {mesh.name: _intervals(mesh, checks) for mesh in meshes if mesh.backend is Backend.BATMAN}
    _check_backends(node, meshes, checks)
    if node.lan_address is not None and (primary is None or primary.backend is not Backend.BATMAN):
        found = "no mesh" if primary is None else primary.backend.value
        message = "a router between the mesh and a LAN needs batman-adv"
        checks.add(COMBINATION, ("robots", node.robot, "lan"), Backend.BATMAN.value, found, message=message)
    if node.lan_address is not None and node.lan_address.version != node.address.version:
        message = "a router's LAN and mesh need addresses of one family"
        expected = f"an IPv{node.address.version} network"
        found = f"an IPv{node.lan_address.version} network"
        checks.add(COMBINATION, ("robots", node.robot, "lan"), expected, found, message=message)
    plan = package_plan(fleet, node)
    radios = _radios(fleet, node, keys, masters, intervals)
    intent = Intent(
        fleet=fleet.name,
        node=node.name,
        hostname=node.hostname,
        label=node.label,
        role=node.role,
        release=node.release,
        board=node.hardware.board,
        radios=radios,
        batman=_batman(meshes, masters, intervals),
        lan=_lan(node, primary, masters),
        backbone=_backbone(node, primary, masters),
        routes=routes(fleet, node),
        lan_filter=_lan_filter(fleet, node, primary, masters),
        login=Login(
            _ssh_port(node), fleet.operators.password_login, _login_keys(fleet, node), _collector_keys(fleet, node)
        ),
        system=fleet.system,
        backend=primary.backend if primary is not None else Backend.BATMAN,
        operator_parts=primary.operator_parts if primary is not None else OperatorParts(),
        packages=plan.install,
        removed_packages=plan.remove,
        extra_uci=node.extra_uci,
        extra_positions={key: checks.position("nodes", node.name, "extra_uci", key) for key in node.extra_uci},
        position=checks.position("nodes", node.name),
    )
    _check_values(fleet, node, intent, checks)
    return intent, tuple(checks.found)


def _check_backends(node: Node, meshes: tuple[Mesh, ...], checks: ValueChecks) -> None:
    """A node runs one back end, with one set of operator parts."""
    path = ("nodes", node.name, "radios")
    if len({mesh.backend for mesh in meshes}) > 1:
        found = ", ".join(f"{mesh.name}: {mesh.backend.value}" for mesh in meshes)
        checks.add(COMBINATION, path, "meshes of one back end", found)
        return
    for name in (each.name for each in fields(OperatorParts)):
        values = {mesh.name: getattr(mesh.operator_parts, name) for mesh in meshes}
        if len(set(values.values())) > 1:
            found = ", ".join(f"{mesh}: {value or 'none'}" for mesh, value in values.items())
            checks.add(COMBINATION, path, f"one `operator_parts.{name}` in all its meshes", found)


def _login_keys(fleet: Fleet, node: Node) -> tuple[str, ...]:
    """The public keys that the node accepts: the operators', and that of its site's worker."""
    site = fleet.worker_site(node)
    return (*fleet.operators.ssh_keys, *((site.worker_key,) if site is not None and site.worker_key else ()))


def _collector_keys(fleet: Fleet, node: Node) -> tuple[str, ...]:
    """The key of the collector on the node's robot, which has it once it was deployed."""
    robot = fleet.robots.get(node.robot or "")
    computer = None if robot is None else robot.computer
    if robot is None or computer is None or not computer.collector or node.name not in robot.nodes:
        return ()
    return (computer.collector_key,) if computer.collector_key else ()


def _primary(meshes: tuple[Mesh, ...], node: Node) -> Mesh | None:
    """The mesh of the node's address, or else its first mesh."""
    holding = (mesh for mesh in meshes if node.address.ip in mesh.network)
    return next(holding, meshes[0] if meshes else None)


def _keys(
    meshes: tuple[Mesh, ...], node: Node, secrets: Callable[[SecretRef], Secret], checks: ValueChecks
) -> dict[str, Secret]:
    keys = {}
    for mesh in meshes:
        checks.mesh(mesh, node.release)
        if mesh.encryption is not Encryption.NONE and mesh.key is not None:
            try:
                keys[mesh.name] = secrets(mesh.key)
            except InputError as error:
                checks.add(SECRET, ("meshes", mesh.name, "key"), "", "", message=str(error), hint=error.hint)
            else:
                checks.key(mesh, keys[mesh.name], node.release)
    return keys


def _masters(meshes: tuple[Mesh, ...]) -> dict[str, str]:
    """Mesh -> its batman-adv interface."""
    names: dict[tuple[IpNetwork, str], str] = {}
    for mesh in meshes:
        if mesh.backend is Backend.BATMAN:
            names.setdefault(_group(mesh), f"bat{len(names)}")
    return {mesh.name: names[_group(mesh)] for mesh in meshes if mesh.backend is Backend.BATMAN}


def _group(mesh: Mesh) -> tuple[IpNetwork, str]:
    return mesh.network, mesh.batman.routing_algo


def _intervals(mesh: Mesh, checks: ValueChecks) -> Intervals:
    try:
        return batman_intervals(mesh)
    except UnreachableTarget as target:
        path = ("meshes", mesh.name, "reconnect_s")
        checks.add(RECONNECT, path, f"at least {target.fastest_s:g} s", f"{mesh.reconnect_s:g} s")
        return Intervals(100, 50)


def _radios(
    fleet: Fleet, node: Node, keys: dict[str, Secret], masters: dict[str, str], intervals: dict[str, Intervals]
) -> tuple[RadioIntent, ...]:
    radios = []
    joined = 0
    for radio in node.radios:
        mesh = fleet.meshes[radio.mesh] if radio.mesh is not None else None
        interface = None
        if mesh is not None:
            elp_ms = intervals[mesh.name].elp_interval_ms if mesh.batman.routing_algo == "BATMAN_V" else None
            interface = _interface(f"mesh{joined}", mesh, keys.get(mesh.name), masters.get(mesh.name, ""), elp_ms)
            joined += 1
        radios.append(_radio(fleet.country, radio, mesh, interface))
    return tuple(radios)


def _interface(name: str, mesh: Mesh, key: Secret | None, master: str, elp_interval_ms: int | None) -> MeshInterface:
    return MeshInterface(
        name=name,
        mesh=mesh.name,
        mode=mesh.mode,
        ssid=mesh.ssid,
        bssid=mesh.bssid,
        mcast_rate_kbps=mesh.mcast_rate_kbps,
        encryption=mesh.encryption,
        key=key,
        mtu=mesh.mtu,
        master=master,
        elp_interval_ms=elp_interval_ms if master else None,
    )


def _radio(country: str, radio: Radio, mesh: Mesh | None, interface: MeshInterface | None) -> RadioIntent:
    return RadioIntent(
        name=radio.name,
        path=radio.hardware.path,
        band=radio.hardware.band,
        country=country,
        channel=mesh.channel if mesh is not None else None,
        htmode=mesh.htmode if mesh is not None else "HT20",
        tx_power_dbm=radio.tx_power_dbm,
        distance_m=mesh.distance_m if mesh is not None else 0,
        beacon_interval_tu=mesh.beacon_interval_tu if mesh is not None else 100,
        interface=interface,
    )


def _batman(
    meshes: tuple[Mesh, ...], masters: dict[str, str], intervals: dict[str, Intervals]
) -> tuple[BatmanInterface, ...]:
    """One interface per group, with the options of its first mesh and the shortest interval."""
    interfaces: dict[str, BatmanInterface] = {}
    for mesh in meshes:
        if mesh.name not in masters:
            continue
        name = masters[mesh.name]
        orig_ms = intervals[mesh.name].orig_interval_ms
        if name in interfaces:
            orig_ms = min(orig_ms, interfaces[name].orig_interval_ms)
            mesh_name, options = interfaces[name].mesh, interfaces[name].options
        else:
            mesh_name, options = mesh.name, mesh.batman
        interfaces[name] = BatmanInterface(name, mesh_name, options, orig_ms)
    return tuple(interfaces.values())


def _backbone(node: Node, primary: Mesh | None, masters: dict[str, str]) -> Backbone | None:
    """A router's interface on the mesh; None on a node that bridges."""
    if node.lan_address is None or primary is None or primary.name not in masters:
        return None
    gateway = None if node.gateway is None or node.gateway in node.lan_address.network else node.gateway
    return Backbone(masters[primary.name], node.address, gateway, primary.lan_mtu)


def _lan(node: Node, primary: Mesh | None, masters: dict[str, str]) -> Lan:
    ports = list(node.lan_ports)
    mtu = primary.lan_mtu if primary is not None else 1500
    if node.lan_address is not None:
        gateway = node.gateway if node.gateway is not None and node.gateway in node.lan_address.network else None
        address = node.lan_address
        return Lan(BRIDGE, tuple(dict.fromkeys(ports)), address, gateway, mtu, node.hardware.switch_vlans)
    if mesh_port := _mesh_port(primary, masters):
        ports.append(mesh_port)
    return Lan(BRIDGE, tuple(dict.fromkeys(ports)), node.address, node.gateway, mtu, node.hardware.switch_vlans)


def _mesh_port(primary: Mesh | None, masters: dict[str, str]) -> str:
    """The bridge's port into the mesh; empty without a mesh, or if meshmerize bridges its interface itself."""
    if primary is None:
        return ""
    return masters[primary.name] if primary.backend is Backend.BATMAN else primary.operator_parts.interface


# DHCP's and DHCPv6's client and server ports (RFC 2131, 4.1; RFC 8415, 7.2)
_DHCP_PORTS = (67, 68, 546, 547)


def _lan_filter(fleet: Fleet, node: Node, primary: Mesh | None, masters: dict[str, str]) -> LanFilterIntent | None:
    port = _mesh_port(primary, masters)
    if node.lan_filter is None or not node.bridges_lan or not port:
        return None
    allowed = {*_DHCP_PORTS, fleet.udp_mesh.port, *node.lan_filter.udp_ports}
    return LanFilterIntent(port, tuple(sorted(allowed)))


def _ssh_port(node: Node) -> int:
    """Dropbear's port: the login port, unless that is the port of a host in front of the node."""
    return SSH_PORT if node.ssh.host else node.ssh.port


def _check_values(fleet: Fleet, node: Node, intent: Intent, checks: ValueChecks) -> None:
    """Hold every text of the intent that did not come from a closed set against what the node can read."""
    path = ("nodes", node.name)
    checks.text(path, intent.node)
    checks.text(("fleet",), intent.fleet)
    checks.word(("country",), fleet.country)
    checks.hostname((*path, "hostname"), intent.hostname)
    checks.text((*path, "label"), intent.label)
    for key, value in intent.extra_uci.items():
        checks.uci_key((*path, "extra_uci", key), key)
        checks.text((*path, "extra_uci", key), value)
    for index, port in enumerate(intent.lan.ports):
        checks.device((*path, "lan_ports", str(index)), port)
    for radio in intent.radios:
        place = ("hardware", node.hardware.name, "radios", radio.name)
        checks.section(place, radio.name)
        checks.text((*place, "path"), radio.path, is_required=True)
        checks.tx_power((*path, "radios", radio.name, "tx_power_dbm"), radio.tx_power_dbm, intent.release)
    checks.text(("system", "timezone"), fleet.system.timezone, is_required=True)
    checks.text(("system", "zonename"), fleet.system.zonename)
    checks.text(("system", "log_host"), fleet.system.log_host)
    for index, server in enumerate(fleet.system.ntp_servers):
        checks.text(("system", "ntp_servers", str(index)), server, is_required=True)
    login = intent.login
    checks.login(login.keys, is_password_allowed=login.is_password_allowed, release=intent.release)
    for key in login.collectors:
        checks.collector(node.robot, key)
