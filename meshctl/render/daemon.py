"""Fleet -> the files of the udp_mesh daemon on a robot's computer: its configuration (TOML) and its key file.

All robots get the same topics, because the sender selects a message's destinations and the receiver requests repair of
a broadcast. The daemon uses only the interface with the computer's address. If a robot has a LAN of its own, where no
broadcast arrives, every daemon gets all others as fixed neighbors: a broadcast link would not reach all of them.
docs/udp-mesh.md describes the format; a test loads the output with the daemon's own reader.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable, Iterator

from meshctl.diagnostics import Diagnostic, InvalidInput, Position, Severity
from meshctl.errors import InputError
from meshctl.model import (
    Computer,
    ComputerLink,
    Fleet,
    MissingOrigin,
    Outbox,
    Robot,
    Secret,
    SecretRef,
    Topic,
    TopicLog,
    UdpMesh,
)
from meshctl.render.thin import thin_lines, thin_problems, thin_topic_lines
from meshctl.resolve import has_routed_lans
from meshctl.wording import counted

# Values that the daemon would reject (docs/render.md).
DAEMON = "RND030"

CONFIG_NAME = "udp-mesh.toml"
KEY_NAME = "fleet.key"
RELAY_KEY_NAME = "relay.key"
LINK_SELECTORS = "an interface or an address"

# Limits of the wire format and the daemon's reader.
_MAX_NAME_BYTES = 63
_MAX_TOPIC_BYTES = 255
_RESERVED_PREFIX = "~mesh/"
_MAX_FRAGMENT_BYTES = 8192
_MAX_WINDOW = 4096
_MAX_RELAY_HOPS = 8
_MAX_KEYS = 2
_KEY_BYTES = 32
# Maximum heartbeat interval of idle peers, unless offline_after_s requires a shorter one (udp_mesh's default).
_MAX_SPARSE_HEARTBEAT_S = 3.0
# Silence after which messages without an outbox count as lost (udp_mesh's default).
_PEER_LOST_S = 60.0
_PEER_NAME = f"a name of 1 to {_MAX_NAME_BYTES} bytes without space or slash"


def daemon_config(fleet: Fleet, robot: str, *, key_name: str = KEY_NAME) -> bytes:
    """The daemon's configuration on the robot's computer; `key_name` is the path of the key file, relative to it.

    Raises InvalidInput for an unknown robot, one without a computer, and every value that the daemon would reject.
    """
    computer = _computer(fleet, robot)
    problems = [
        *_check_robot(fleet, robot),
        *_check_relay(fleet, robot),
        *_check_links(fleet, robot, computer),
        *(_problem(fleet, *problem) for problem in thin_problems(fleet, robot)),
        *_check_transport(fleet),
        *_check_topics(fleet),
    ]
    if problems:
        raise InvalidInput(problems)
    transport = fleet.udp_mesh
    lines = [
        f"# {robot} of {fleet.name}, written by meshctl: change the inventory, not this file.",
        f"name = {_text(robot)}",
        f"port = {transport.port}",
        f"key_file = {_text(key_name)}" if transport.keys else "unkeyed = true",
        f"window = {transport.window}" if transport.window is not None else 'window = "adaptive"',
        f"fragment_bytes = {transport.fragment_bytes}",
        *_optional(fleet.robots[robot], transport),
        *_rates(transport),
        *_position(fleet, robot),
        *_links(fleet, robot, computer),
        *_legacy_peers(fleet, robot),
        *thin_lines(fleet, robot),
        *(line for topic in fleet.topics for line in _topic(topic, robot)),
    ]
    if transport.metrics_port is not None:
        # metrics are local; collect them through SSH or an exporter
        lines += ["", "[daemon]", f'metrics_address = "127.0.0.1:{transport.metrics_port}"']
    return "".join(f"{line}\n" for line in lines).encode()


def daemon_keys(fleet: Fleet, secrets: Callable[[SecretRef], Secret]) -> bytes | None:
    """The key file: one key per line, the sending key first; None for a fleet without keys. Store it with mode 0600.

    Raises InvalidInput for an invalid key, without showing the key.
    """
    return _key_file(fleet, "keys", fleet.udp_mesh.keys, secrets)


def relay_keys(fleet: Fleet, secrets: Callable[[SecretRef], Secret]) -> bytes | None:
    """The file of the hops' keys (`RELAY_KEY_NAME`), as `daemon_keys`."""
    return _key_file(fleet, "relay_keys", fleet.udp_mesh.relay_keys, secrets)


def _key_file(
    fleet: Fleet, key: str, refs: tuple[SecretRef, ...], secrets: Callable[[SecretRef], Secret]
) -> bytes | None:
    lines = []
    problems = []
    for index, ref in enumerate(refs):
        path = ("udp_mesh", key, str(index))
        try:
            text = key_text(secrets(ref))
        except InputError as error:
            problems.append(_problem(fleet, path, "", "", message=str(error), hint=error.hint))
            continue
        if key_bytes(text) is None:
            found = counted(len(text), "character")
            hint = "generate one with `openssl rand -hex 32` or `udp-mesh keygen FILE`"
            expected = f"a key of {_KEY_BYTES} bytes as 64 hex digits or 44 characters of base64"
            problems.append(_problem(fleet, path, expected, found, hint=hint))
        lines.append(f"{text}\n")
    if problems:
        raise InvalidInput(problems)
    return "".join(lines).encode() or None


def key_text(secret: Secret) -> str:
    """The key on a line of a key file, without the key id that `udp-mesh keygen` writes after `#`."""
    return secret.reveal().split("#", 1)[0].strip()


def key_bytes(text: str) -> bytes | None:
    """The 32 bytes of a hexadecimal or base64 key; None for anything else."""
    try:
        raw = bytes.fromhex(text) if len(text) == 2 * _KEY_BYTES else base64.b64decode(text, validate=True)
    except (ValueError, binascii.Error):
        return None
    return raw if len(raw) == _KEY_BYTES else None


def _computer(fleet: Fleet, name: str) -> Computer:
    robot = fleet.robots.get(name)
    if robot is None:
        raise InvalidInput([_problem(fleet, ("robots",), "a robot of the fleet", repr(name))])
    if robot.computer is None:
        raise InvalidInput([_problem(fleet, ("robots", name, "computer"), "a robot with a computer", "none")])
    return robot.computer


def _check_robot(fleet: Fleet, name: str) -> Iterator[Diagnostic]:
    """Check the peer name. Names are parts of topic names, so slashes are not allowed."""
    if not _is_peer_name(name):
        yield _problem(fleet, ("robots", name), _PEER_NAME, repr(name))


def _check_relay(fleet: Fleet, robot: str) -> Iterator[Diagnostic]:
    relay = fleet.robots[robot].relay
    for index, name in enumerate(relay):
        if not _is_peer_name(name):
            yield _problem(fleet, ("robots", robot, "relay", str(index)), _PEER_NAME, repr(name))
    hops = fleet.udp_mesh.relay_hops
    if not 1 <= hops <= _MAX_RELAY_HOPS:
        yield _problem(fleet, ("udp_mesh", "relay_hops"), f"1 to {_MAX_RELAY_HOPS}", str(hops))
    elif relay and hops == 1:
        yield _problem(fleet, ("udp_mesh", "relay_hops"), f"at least 2, because {robot} is a relay", "1")


def _check_links(fleet: Fleet, robot: str, computer: Computer) -> Iterator[Diagnostic]:
    for index, is_repeated, found in link_problems(computer):
        path = ("robots", robot, "computer", "links", str(index))
        yield _problem(fleet, path, "another link than those before" if is_repeated else LINK_SELECTORS, found)


def link_problems(computer: Computer) -> Iterator[tuple[int, bool, str]]:
    """The further links that a daemon rejects: (index, whether an earlier one is the same, what is there). Others have
    not exactly one of `LINK_SELECTORS`."""
    taken = {str(computer.address.ip)}
    for index, link in enumerate(computer.links):
        selector = link_selector(link)
        if bool(link.interface) is (link.address is not None):
            yield index, False, "both" if link.interface else "neither"
        elif selector in taken:
            yield index, True, selector
        taken.add(selector)


def link_selector(link: ComputerLink) -> str:
    """The interface or address that selects a link; empty if neither is set."""
    return str(link.address) if link.address is not None else link.interface


def _is_peer_name(text: str) -> bool:
    return _is_name(text, _MAX_NAME_BYTES) and "/" not in text


def _is_name(text: str, limit_bytes: int) -> bool:
    size = len(text.encode("utf-8", "surrogatepass"))
    return 1 <= size <= limit_bytes and text.isprintable() and not any(letter.isspace() for letter in text)


def _check_transport(fleet: Fleet) -> Iterator[Diagnostic]:
    transport = fleet.udp_mesh
    if transport.fragment_bytes > _MAX_FRAGMENT_BYTES:
        found = str(transport.fragment_bytes)
        yield _problem(fleet, ("udp_mesh", "fragment_bytes"), f"at most {_MAX_FRAGMENT_BYTES}", found)
    if transport.window is not None and not 1 <= transport.window <= _MAX_WINDOW:
        expected = f"adaptive, or 1 to {_MAX_WINDOW} fragments"
        yield _problem(fleet, ("udp_mesh", "window"), expected, str(transport.window))
    for name, keys in (("keys", transport.keys), ("relay_keys", transport.relay_keys)):
        if len(keys) > _MAX_KEYS:
            yield _problem(fleet, ("udp_mesh", name), f"at most {_MAX_KEYS} live keys", str(len(keys)))


def _check_topics(fleet: Fleet) -> Iterator[Diagnostic]:
    for topic in fleet.topics:
        path = ("topics", topic.name)
        if not _is_name(topic.name, _MAX_TOPIC_BYTES) or topic.name.startswith(_RESERVED_PREFIX):
            expected = f"a topic of 1 to {_MAX_TOPIC_BYTES} bytes without space, not below {_RESERVED_PREFIX}"
            yield _problem(fleet, path, expected, repr(topic.name))


def _rates(transport: UdpMesh) -> Iterator[str]:
    sparse_s = max(transport.heartbeat_s, min(_MAX_SPARSE_HEARTBEAT_S, 0.3 * transport.offline_after_s))
    yield ""
    yield "[rates]"
    yield f"heartbeat_s = {_number(transport.heartbeat_s)}"
    # three missed heartbeats fit into offline_s at any rate
    yield f"heartbeat_sparse_s = {_number(sparse_s)}"
    yield f"offline_s = {_number(transport.offline_after_s)}"
    yield f"peer_lost_s = {_number(max(_PEER_LOST_S, transport.offline_after_s))}"


def _links(fleet: Fleet, robot: str, computer: Computer) -> Iterator[str]:
    uses_broadcast = fleet.udp_mesh.broadcast and not has_routed_lans(fleet)
    kind = "broadcast" if uses_broadcast else "neighbours"
    yield from ("", "[[links]]", f'address = "{computer.address.ip}"', f'kind = "{kind}"')
    if not uses_broadcast:
        for peer in _others(fleet, robot):
            if peer.computer is not None:
                yield from _neighbor(peer.name, str(peer.computer.address.ip))
    for link in computer.links:
        yield from _further_link(link)


def _further_link(link: ComputerLink) -> Iterator[str]:
    """Its neighbors need no names: the first link may already name the same robots."""
    selector = _text(link_selector(link))
    yield from ("", "[[links]]", f"{'interface' if link.address is None else 'address'} = {selector}")
    yield f'kind = "{"neighbours" if link.neighbors else "broadcast"}"'
    if link.mtu is not None:
        yield f"mtu = {link.mtu}"
    for address in link.neighbors.values():
        yield from ("", "[[neighbours]]", f'address = "{address}"', f"link = {selector}")


def _optional(robot: Robot, transport: UdpMesh) -> Iterator[str]:
    """Only what differs from the daemon's defaults: daemons of earlier versions reject unknown keys."""
    if robot.relay:
        yield f"relay = [{', '.join(map(_text, robot.relay))}]"
    if transport.relay_hops != UdpMesh().relay_hops:
        yield f"relay_hops = {transport.relay_hops}"
    if transport.relay_keys:
        yield f"relay_key_file = {_text(RELAY_KEY_NAME)}"
    if not transport.selective:
        yield "selective = false"


def _position(fleet: Fleet, robot: str) -> Iterator[str]:
    """Where the robot or its first radio with a position stands."""
    own = fleet.robots[robot]
    nodes = (fleet.nodes[name].position for name in own.nodes if name in fleet.nodes)
    place = own.position or next((node for node in nodes if node is not None), None)
    if place is not None:
        yield from ("", "[position]", f"x_m = {_number(place.x_m)}", f"y_m = {_number(place.y_m)}")
        if place.z_m is not None:
            yield f"z_m = {_number(place.z_m)}"


def _neighbor(name: str, address: str) -> tuple[str, ...]:
    return ("", "[[neighbours]]", f"name = {_text(name)}", f'address = "{address}"')


def _legacy_peers(fleet: Fleet, robot: str) -> Iterator[str]:
    """Robots with the legacy udp_mesh, addressed in its format. Every daemon on the network must know each of them:
    broadcasts of one that does not would crash the legacy program."""
    for peer in _others(fleet, robot):
        if peer.fielded is not None:
            yield from (*_neighbor(peer.name, str(peer.fielded)), "legacy = true")


def _others(fleet: Fleet, robot: str) -> Iterator[Robot]:
    return (peer for peer in fleet.robots.values() if peer.name != robot)


def _topic(topic: Topic, robot: str) -> Iterator[str]:
    yield from ("", f"[topics.{_text(topic.name)}]")
    yield f"priority = {topic.priority}"
    yield f"reliable = {_boolean(topic.reliable)}"
    if topic.log is not None:
        yield from _log(topic, topic.log)
        return
    destinations = _destinations(topic, robot)
    if destinations:
        yield f"destinations = [{', '.join(_text(name) for name in destinations)}]"
    if topic.keep_last:
        yield f"keep_last = {topic.keep_last}"
    if topic.deadline_s is not None:
        yield f"deadline_s = {_number(topic.deadline_s)}"
    if topic.rate_limit_bytes_per_s is not None:
        yield f"rate_limit_bytes_per_s = {topic.rate_limit_bytes_per_s}"
    if topic.compression:
        yield "compression = true"
    if topic.outbox is not Outbox.NONE:
        yield f'outbox = "{topic.outbox.value}"'
        yield f"outbox_bytes = {topic.outbox_bytes}"
        yield f"outbox_on_disk = {_boolean(topic.outbox_on_disk)}"
    if topic.repair:
        yield "repair = true"
    if topic.delta:
        yield "delta = true"
        yield f"delta_bytes = {topic.delta_bytes}"
    if topic.always:
        yield "always = true"
    yield from thin_topic_lines(topic)


def _log(topic: Topic, log: TopicLog) -> Iterator[str]:
    """A log's readers are the topic's destinations, on every robot."""
    if topic.rate_limit_bytes_per_s is not None:
        yield f"rate_limit_bytes_per_s = {topic.rate_limit_bytes_per_s}"
    if topic.compression:
        yield "compression = true"
    yield from ("", f"[topics.{_text(topic.name)}.log]")
    if "all" not in topic.destinations:
        yield f"readers = [{', '.join(_text(name) for name in topic.destinations)}]"
    yield f"max_items = {log.max_items}"
    yield f"max_bytes = {log.max_bytes}"
    if log.max_age_s is not None:
        yield f"max_age_s = {_number(log.max_age_s)}"
    yield f"copies = {log.copies}"


def _destinations(topic: Topic, robot: str) -> tuple[str, ...]:
    """The destinations of this robot's messages; none means all. A topic for this robot alone keeps its name, because
    messages from others are not broadcasts."""
    if "all" in topic.destinations:
        return ()
    others = tuple(name for name in topic.destinations if name != robot)
    return others or topic.destinations


def _text(value: str) -> str:
    """A TOML basic string: JSON's escapes, and TOML's for DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _boolean(value: bool) -> str:
    return "true" if value else "false"


def _number(value: float) -> str:
    return repr(float(value))


def _problem(
    fleet: Fleet, path: tuple[str, ...], expected: str, found: str, *, message: str = "", hint: str = ""
) -> Diagnostic:
    try:
        place = fleet.where(*path).position
    except MissingOrigin:
        place = Position(fleet.files[0] if fleet.files else fleet.name)
    return Diagnostic(DAEMON, Severity.ERROR, place, message, ".".join(path), expected, found, hint)
