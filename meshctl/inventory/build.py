"""Document + node specs -> fleet: each section turned into the model's frozen values.

Order: hardware, meshes, robots (which assign nodes), nodes, topics, settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_interface
from pathlib import Path
from types import MappingProxyType

from meshctl.diagnostics import Diagnostic, Position
from meshctl.inventory import codes
from meshctl.inventory.compose import printable
from meshctl.inventory.documents import (
    ComputerDocument,
    HardwareDocument,
    InventoryDocument,
    LanDocument,
    MeshDocument,
    NatsHubDocument,
    OtherComputerDocument,
    RobotDocument,
    SecretDocument,
    SiteDocument,
    SshLayer,
    SystemDocument,
)
from meshctl.inventory.file_paths import base_of, path_of, paths_of
from meshctl.inventory.layers import NodeSpec
from meshctl.inventory.nodes import build_nodes, fixed_position, ssh_settings, ssh_values
from meshctl.inventory.provenance import Provenance
from meshctl.inventory.ranges import MAX_NAMES, BadRange, expand
from meshctl.inventory.thin import thin_links, thin_ports
from meshctl.inventory.topics import topic_of
from meshctl.inventory.tree import MappingNode, descend, position_of
from meshctl.model import (
    ApplyPolicy,
    Batman,
    Computer,
    ComputerLink,
    Firmware,
    Fleet,
    HardwareProfile,
    Mesh,
    NatsHub,
    OperatorParts,
    Operators,
    RadioHardware,
    Robot,
    SecretKind,
    SecretRef,
    Site,
    SiteNats,
    SshSettings,
    SystemSettings,
    UdpMesh,
)
from meshctl.model.ip import IpAddress, IpInterface
from meshctl.suggest import did_you_mean


@dataclass(frozen=True, slots=True)
class Built:
    """`fleet` is None if there is any diagnostic."""

    fleet: Fleet | None
    diagnostics: tuple[Diagnostic, ...]


def build(
    document: InventoryDocument, root: MappingNode, specs: Mapping[str, NodeSpec], files: tuple[Path, ...]
) -> Built:
    """`files` are all files read, starting with the first one."""
    hardware = {name: _hardware(name, item, root) for name, item in document.hardware.items()}
    meshes = {name: _mesh(name, item, root) for name, item in document.meshes.items()}
    diagnostics: list[Diagnostic] = []
    robots = _robots(document, root, diagnostics)
    robot_of: dict[str, str] = {}
    for names in ("nodes", "carries"):
        for robot in robots.values():
            for node in getattr(robot, names):
                robot_of.setdefault(node, robot.name)
    lan_addresses = _lan_addresses(document, robots, root, diagnostics)
    built = build_nodes(specs, hardware, meshes, robot_of, lan_addresses, base_of(root))
    diagnostics.extend(built.diagnostics)
    if diagnostics:
        return Built(None, tuple(diagnostics))
    fleet = Fleet(
        name=document.fleet,
        country=document.country,
        meshes=MappingProxyType(meshes),
        hardware=MappingProxyType(hardware),
        nodes=MappingProxyType(built.nodes),
        robots=MappingProxyType(robots),
        topics=tuple(topic_of(name, item) for name, item in document.topics.items()),
        udp_mesh=_udp_mesh(document, root),
        operators=Operators(
            ssh_keys=tuple(document.operators.ssh_keys),
            password_login=document.operators.password_login,
            known_hosts=path_of(root, document.operators.known_hosts, "operators", "known_hosts"),
        ),
        system=SystemSettings(
            timezone=document.system.timezone,
            zonename=_zonename(document.system),
            log_size_kib=document.system.log_size_kib,
            log_host=document.system.log_host,
            log_port=document.system.log_port,
            ntp_servers=tuple(document.system.ntp_servers),
        ),
        apply=ApplyPolicy(
            max_down=document.apply.max_down,
            canary=document.apply.canary,
            stop_after_failures=document.apply.stop_after_failures,
            quorum=document.apply.quorum,
            parallel=document.apply.parallel,
        ),
        provenance=Provenance(root, specs, robot_of),
        files=tuple(str(path) for path in files),
        base=base_of(root),
        sites=MappingProxyType({name: _site(name, item, root) for name, item in document.sites.items()}),
        nats=_nats_hub(document.nats, root),
    )
    return Built(fleet, ())


def _zonename(document: SystemDocument) -> str:
    """Images with zoneinfo packages prefer the name to `timezone`, so UTC is no default beside another time zone."""
    if document.zonename is not None:
        return document.zonename
    return "UTC" if document.timezone == "UTC" else ""


def _hardware(name: str, document: HardwareDocument, root: MappingNode) -> HardwareProfile:
    return HardwareProfile(
        name=name,
        board=document.board,
        profile=document.profile,
        target=document.target,
        release=document.release,
        radios=tuple(
            RadioHardware(
                name=radio_name,
                path=radio.path,
                band=radio.band,
                rated_power_dbm=radio.rated_power_dbm,
                max_drive_dbm=radio.max_drive_dbm,
                amplifier_gain_db=radio.amplifier_gain_db,
                antenna_gain_dbi=radio.antenna_gain_dbi,
                cable_loss_db=radio.cable_loss_db,
                antenna=radio.antenna,
                beamwidth_deg=radio.beamwidth_deg,
                chains=radio.chains,
                driver=radio.driver,
            )
            for radio_name, radio in document.radios.items()
        ),
        lan_ports=tuple(document.lan_ports),
        memory_mib=document.memory_mib,
        flash_mib=document.flash_mib,
        firmware=Firmware(
            image=document.firmware.image,
            sha256=document.firmware.sha256.lower(),
            revision=document.firmware.revision,
            usign_key=document.firmware.usign_key,
            base=base_of(root, "hardware", name, "firmware"),
        ),
        packages=tuple(document.packages),
        package_files=paths_of(root, document.package_files, "hardware", name, "package_files"),
        confirm_window_s=document.confirm_window_s,
        flash_timeout_s=document.flash_timeout_s,
        recovery=document.recovery,
        switch_vlans=tuple(document.switch_vlans.items()),
    )


def _mesh(name: str, document: MeshDocument, root: MappingNode) -> Mesh:
    batman, parts = document.batman, document.operator_parts
    return Mesh(
        name=name,
        ssid=document.ssid,
        bssid=document.bssid,
        band=document.band,
        channel=document.channel,
        network=document.network,
        htmode=document.htmode,
        mode=document.mode,
        encryption=document.encryption,
        key=_secret(document.key, base_of(root, "meshes", name, "key")) if document.key is not None else None,
        mcast_rate_kbps=document.mcast_rate_kbps,
        distance_m=document.distance_m,
        beacon_interval_tu=document.beacon_interval_tu,
        mtu=document.mtu,
        lan_mtu=document.lan_mtu,
        reconnect_s=document.reconnect_s,
        min_beacons=document.min_beacons,
        backend=document.backend,
        batman=Batman(
            routing_algo=batman.routing_algo,
            bridge_loop_avoidance=batman.bridge_loop_avoidance,
            distributed_arp_table=batman.distributed_arp_table,
            aggregated_ogms=batman.aggregated_ogms,
            multicast_mode=batman.multicast_mode,
            fragmentation=batman.fragmentation,
            hop_penalty=batman.hop_penalty,
            orig_interval_ms=batman.orig_interval_ms,
            elp_interval_ms=batman.elp_interval_ms,
            gw_mode=batman.gw_mode,
        ),
        operator_parts=OperatorParts(
            templates=parts.templates,
            package_files=paths_of(root, parts.package_files, "meshes", name, "operator_parts", "package_files"),
            packages=tuple(parts.packages),
            service=parts.service,
            status_command=parts.status_command,
            interface=parts.interface,
            base=base_of(root, "meshes", name, "operator_parts"),
        ),
    )


def _secret(document: SecretDocument, base: str) -> SecretRef:
    if document.env:
        return SecretRef(SecretKind.ENV, document.env, base=base)
    if document.file:
        return SecretRef(SecretKind.FILE, document.file, document.key, base=base)
    return SecretRef(SecretKind.AGE, document.age, document.key, document.identity, base)


def _robots(document: InventoryDocument, root: MappingNode, diagnostics: list[Diagnostic]) -> dict[str, Robot]:
    """All robots, up to the first invalid list: one line may expand to many names."""
    robots: dict[str, Robot] = {}
    count = 0
    for name, item in document.robots.items():
        robot = robots[name] = _robot(name, item, root, diagnostics)
        count += len(robot.nodes) + len(robot.carries)
        if count > MAX_NAMES:
            place = position_of(root, ("robots", name)) or Position(root.file)
            message = f"the robots list more than {MAX_NAMES} nodes"
            diagnostics.append(codes.error(codes.BAD_RANGE, place, message, path=f"robots.{name}"))
        if diagnostics:
            break
    return robots


def _robot(name: str, document: RobotDocument, root: MappingNode, diagnostics: list[Diagnostic]) -> Robot:
    return Robot(
        name=name,
        nodes=_names(("robots", name, "nodes"), document.nodes, root, diagnostics),
        computer=_computer(document.computer, root, "robots", name, "computer")
        if document.computer is not None
        else None,
        is_base=document.is_base,
        carries=_names(("robots", name, "carries"), document.carries, root, diagnostics),
        fielded=document.fielded,
        lan=document.lan.network if document.lan is not None else None,
        computers=MappingProxyType(
            {
                computer: _other_computer(item, root, "robots", name, "computers", computer)
                for computer, item in document.computers.items()
            }
        ),
        position=fixed_position(document.position),
        relay=document.relay,
        thin=thin_ports(document.thin),
    )


def _lan_addresses(
    document: InventoryDocument, robots: Mapping[str, Robot], root: MappingNode, diagnostics: list[Diagnostic]
) -> dict[str, IpInterface]:
    """The address of each radio in its robot's own LAN: as set, else the first ones in the order of `nodes`."""
    found: dict[str, IpInterface] = {}
    for name, robot in robots.items():
        if robot.lan is None:
            continue
        lan = document.robots[name].lan
        for node in lan.addresses.keys() - set(robot.nodes):
            path = ("robots", name, "lan", "addresses", node)
            place = position_of(root, path) or Position(root.file)
            message = f"the robot has no radio '{node}'"
            hint = did_you_mean(node, robot.nodes)
            diagnostics.append(codes.error(codes.BAD_ADDRESS, place, message, path=".".join(path), hint=hint))
        for index, node in enumerate(dict.fromkeys(robot.nodes)):
            address = lan.addresses.get(node) or _host(lan, index)
            if address is None:
                place = position_of(root, ("robots", name, "lan")) or Position(root.file)
                message = f"{lan.network} has no address for the radio '{node}'"
                diagnostics.append(codes.error(codes.BAD_ADDRESS, place, message, path=f"robots.{name}.lan"))
                break
            found.setdefault(node, ip_interface((address, lan.network.prefixlen)))
    return found


def _host(lan: LanDocument, index: int) -> IpAddress | None:
    """The LAN's host address with `index` (from 0); None beyond its last."""
    return lan.network[index + 1] if index + 2 < lan.network.num_addresses else None


def _names(
    path: tuple[str, ...], patterns: tuple[str, ...], root: MappingNode, diagnostics: list[Diagnostic]
) -> tuple[str, ...]:
    """The nodes in a robot's list, with ranges expanded."""
    made: list[str] = []
    for number, pattern in enumerate(patterns):
        try:
            made.extend(expand(pattern))
            if len(made) > MAX_NAMES:
                raise BadRange(f"the list expands to more than {MAX_NAMES} names")
        except BadRange as reason:
            diagnostics.append(
                codes.error(
                    codes.BAD_RANGE,
                    position_of(root, (*path, number)) or Position(root.file),
                    f"invalid range (expected e.g. b[01-12]): {reason}",
                    path=".".join(path),
                    found=f"'{printable(pattern)}'",
                )
            )
            break
    return tuple(made)


def _other_computer(document: OtherComputerDocument, root: MappingNode, *path: str) -> Computer:
    return Computer(document.address, _computer_ssh(document.ssh, root, *path))


def _site(name: str, document: SiteDocument, root: MappingNode) -> Site:
    nats = None
    if document.nats is not None:
        nats = SiteNats(document.nats.domain or name, document.nats.url)
    return Site(name, _computer_ssh(document.ssh, root, "sites", name), document.worker_key, nats)


def _nats_hub(document: NatsHubDocument | None, root: MappingNode) -> NatsHub | None:
    if document is None:
        return None
    return NatsHub(
        document.url,
        path_of(root, document.credentials, "nats", "credentials") if document.credentials else "",
        path_of(root, document.ca, "nats", "ca") if document.ca else "",
        document.domain,
        document.order_hours,
    )


def _computer_ssh(document: SshLayer, root: MappingNode, *path: str) -> SshSettings:
    return ssh_settings(ssh_values(document, descend(root, (*path, "ssh")), base_of(root)), user="")


def _computer(document: ComputerDocument, root: MappingNode, *path: str) -> Computer:
    return Computer(
        address=document.address,
        ssh=_computer_ssh(document.ssh, root, *path),
        python=document.python,
        arch=document.arch,
        ros=document.ros,
        gateway=document.gateway,
        links=tuple(
            ComputerLink(link.interface, link.address, MappingProxyType(dict(link.neighbors)), link.mtu)
            for link in document.links
        ),
        collector=document.collector,
        collector_key=document.collector_key,
    )


def _transport_keys(documents: tuple[SecretDocument, ...], key: str, root: MappingNode) -> tuple[SecretRef, ...]:
    return tuple(_secret(item, base_of(root, "udp_mesh", key, number)) for number, item in enumerate(documents))


def _udp_mesh(document: InventoryDocument, root: MappingNode) -> UdpMesh:
    settings = document.udp_mesh
    return UdpMesh(
        port=settings.port,
        keys=_transport_keys(settings.keys, "keys", root),
        heartbeat_s=settings.heartbeat_s,
        offline_after_s=settings.offline_after_s,
        fragment_bytes=settings.fragment_bytes,
        window=settings.window,
        broadcast=settings.broadcast,
        metrics_port=settings.metrics_port,
        relay_hops=settings.relay_hops,
        relay_keys=_transport_keys(settings.relay_keys, "relay_keys", root),
        thin_links=thin_links(settings.thin_links),
        thin_presence_s=settings.thin_presence_s,
        etc_hosts=settings.etc_hosts,
        selective=settings.selective,
    )
