"""The Zenoh bridge: `python -m udp_mesh.bridges.zenoh_bridge --route 'demo/**=telemetry' --ros2 /chatter=talk ...`.

1. A sample under a routed key expression is encoded (`envelope`) and published on the route's mesh topic.
2. A sample from another Zenoh bridge is put under its own key, with its encoding, attachment and quality of service.
3. The liveliness tokens of routed ROS 2 topics are synchronized between both sides (`rmw_zenoh`).
4. Late joiners get the cached samples of transient local publishers: these are sent again when a robot comes online.

Samples from the mesh are never sent back: each bridge declares a token `udp_mesh/bridge/<session>`, names its session
in every sample it puts, and drops samples of every session that has such a token. Requires `eclipse-zenoh`.
"""

from __future__ import annotations

import argparse
import logging
import re
import signal
import sys
import threading
from typing import Any, NamedTuple, Sequence

try:
    import zenoh
except ModuleNotFoundError as error:
    raise SystemExit("udp_mesh.bridges.zenoh_bridge: {} (pip install eclipse-zenoh)".format(error)) from error

from udp_mesh.bridges.daemon_client import DaemonClient
from udp_mesh.bridges.envelope import TYPE, Envelope, EnvelopeError, open_envelope, seal
from udp_mesh.bridges.receiving import Receive, parse_receive, with_needed
from udp_mesh.bridges.rmw_zenoh import (
    CARRIED,
    HISTORY,
    AnnouncementError,
    SampleDeduplicator,
    TokenChange,
    TokenExchange,
    carried_key,
    kept_samples,
    publisher_tokens,
    topic_keys,
)
from udp_mesh.bridges.zenoh_publishers import Publishers
from udp_mesh.client.mesh_client import DEFAULT_SOCKET, Frame, MeshError, Message, as_message

log = logging.getLogger(__name__)

PROTOCOL_TOPIC = "bridge/zenoh"
PROTOCOL_TOPIC_SETTINGS = {"priority": 1, "reliable": True, "compression": True, "keep_last": 1, "outbox": "last"}
"""Announcements are complete, so only the last one matters, also for an offline peer."""
BRIDGE = "udp_mesh/bridge"
REFRESH_S = 1.0
HISTORY_TIMEOUT_S = 10.0
"""How long publishers may take to answer a query for cached samples."""


class KeyRoute(NamedTuple):
    """Samples under `keys` go to the mesh topic, to these peers (none: the topic's destinations, or all)."""

    keys: str
    topic: str
    peers: tuple[str, ...]
    tokens: str | None = None
    """ROS 2: the key expression of the publishers' tokens."""


def parse_route(text: str) -> KeyRoute:
    """`KEYEXPR=TOPIC[@PEER,PEER]`. Raises argparse.ArgumentTypeError."""
    keys, _, rest = text.rpartition("=")
    topic, _, peers = rest.partition("@")
    try:
        zenoh.KeyExpr(keys)
    except zenoh.ZError as error:
        raise argparse.ArgumentTypeError("{!r}: expected KEYEXPR=TOPIC[@PEER,...]: {}".format(text, error)) from error
    if not topic:
        raise argparse.ArgumentTypeError("{!r}: expected KEYEXPR=TOPIC[@PEER,...], found no topic".format(text))
    return KeyRoute(keys, topic, tuple(peer for peer in peers.split(",") if peer))


def parse_ros2_route(text: str) -> KeyRoute:
    """`[DOMAIN:]/ros/topic=TOPIC[@PEER,PEER]`. Raises argparse.ArgumentTypeError."""
    found = re.fullmatch(r"(?:(\d+):)?(/?[A-Za-z_][\w/]*)=([^@]+)(?:@(.+))?", text)
    if found is None:
        raise argparse.ArgumentTypeError("{!r}: expected [DOMAIN:]/ros/topic=TOPIC[@PEER,...]".format(text))
    domain, name, topic, peers = int(found[1] or 0), found[2], found[3], found[4] or ""
    chosen = tuple(peer for peer in peers.split(",") if peer)
    return KeyRoute(topic_keys(name, domain), topic, chosen, publisher_tokens(name, domain))


class ZenohBridge:
    """The running bridge. Zenoh calls back on its own threads, the daemon client on another; `_lock` guards the shared
    state."""

    def __init__(self, daemon: DaemonClient, session: Any, routes: Sequence[KeyRoute]) -> None:
        self._daemon = daemon
        self._session = session
        self._own = str(session.info.zid())
        self._routes = routes
        # Zenoh may call back from within a declaration.
        self._lock = threading.RLock()
        self._bridges = {self._own}
        self._token_exchange = TokenExchange()
        self._announced = b""
        self._publishers = Publishers(session, self._token_exchange.depth)
        self._deduplicator = SampleDeduplicator()
        self._tokens: dict[str, tuple[Any, Any]] = {}
        self._declarations: list[Any] = []

    def start(self) -> None:
        """Declares everything. The token that identifies this bridge comes before the first sample."""
        live = self._session.liveliness()
        self._declarations.append(live.declare_token("{}/{}".format(BRIDGE, self._own)))
        self._declarations.append(live.declare_subscriber(BRIDGE + "/*", self._on_bridge_token, history=True))
        self._declarations.append(live.declare_subscriber(CARRIED + "/**", self._on_companion, history=True))
        for route in self._routes:
            if route.tokens is not None:
                self._declarations.append(live.declare_subscriber(route.tokens, self._on_token, history=True))
            self._declarations.append(
                self._session.declare_subscriber(
                    route.keys,
                    lambda sample, route=route: self._from_zenoh(sample, route),
                    allowed_origin=zenoh.Locality.REMOTE,
                )
            )

    # Zenoh -> mesh

    def _from_zenoh(self, sample: Any, route: KeyRoute) -> None:
        if not self._is_from_bridge(sample):
            self._send(sample, route, route.peers or (None,))

    def _is_from_bridge(self, sample: Any) -> bool:
        source = sample.source_info
        return source is not None and str(source.source_id.zid) in self._bridges

    def _send(self, sample: Any, route: KeyRoute, peers: Sequence[str | None], *, again: bool = False) -> None:
        attachment = sample.attachment
        envelope = Envelope(
            str(sample.key_expr),
            bytes(sample.payload),
            str(sample.encoding),
            None if attachment is None else bytes(attachment),
            int(sample.priority),
            sample.congestion_control == zenoh.CongestionControl.BLOCK,
            bool(sample.express),
            sample.kind == zenoh.SampleKind.DELETE,
            again,
        )
        try:
            sealed = seal(envelope)
        except EnvelopeError as error:
            log.warning("sample-dropped key=%.80s %s", envelope.key, error)
            return
        for peer in peers:
            self._daemon.publish(route.topic, sealed, peer, TYPE)

    def _send_history(self, keys: Sequence[str], peer: str | None = None) -> None:
        """Sends cached samples of our side's publishers to one robot or to all, which drop those they already have."""
        for route in self._routes:
            if route.tokens is None or (route.peers and peer is not None and peer not in route.peers):
                continue
            peers = (peer,) if peer is not None else route.peers or (None,)
            for key in keys:
                if zenoh.KeyExpr(route.keys).includes(zenoh.KeyExpr(key)):
                    self._query(key, route, peers)

    def _query(self, key: str, route: KeyRoute, peers: Sequence[str | None]) -> None:
        def answered(reply: Any) -> None:
            if reply.ok is not None and not self._is_from_bridge(reply.ok):
                self._send(reply.ok, route, peers, again=True)

        # A reply's key is the publisher's, not the queried one.
        selector = "{}/{}?_anyke".format(key, HISTORY)
        self._session.get(selector, answered, consolidation=zenoh.ConsolidationMode.NONE, timeout=HISTORY_TIMEOUT_S)

    def _on_bridge_token(self, sample: Any) -> None:
        zid = str(sample.key_expr).rpartition("/")[2]
        (self._bridges.add if sample.kind == zenoh.SampleKind.PUT else self._bridges.discard)(zid)

    def _on_token(self, sample: Any) -> None:
        token, alive = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
        with self._lock:
            self._token_exchange.on_token(token, alive)
            keys = self._token_exchange.keeping_keys()
        self.announce()
        key = kept_samples(token)[0]
        if alive and key in keys:
            # It may have published before our subscription.
            self._send_history([key])

    def _on_companion(self, sample: Any) -> None:
        with self._lock:
            self._token_exchange.on_companion(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)
        self.announce()

    def announce(self, peer: str | None = None, *, answer: bool = False) -> None:
        """Announces our side's tokens: to all bridges if they changed, or to one bridge in any case."""
        with self._lock:
            announcement = self._token_exchange.announcement(answer=answer)
            if peer is None and not answer and announcement == self._announced:
                return
            # Under the lock, so that the later of two announcements leaves last.
            if self._daemon.publish(PROTOCOL_TOPIC, announcement, peer, TYPE) and peer is None:
                self._announced = announcement

    # Mesh -> Zenoh

    def on_daemon_up(self) -> None:
        """Called by the daemon client after each connect."""
        self.ensure_topic()
        self.announce(answer=True)
        self._send_history(self._keeping_keys())

    def _keeping_keys(self) -> list[str]:
        with self._lock:
            return self._token_exchange.keeping_keys()

    def on_frame(self, frame: Frame) -> None:
        """Called by the daemon client for each frame."""
        message, header = as_message(frame), frame[0]
        if message is not None and message.type == TYPE:
            try:
                if message.topic == PROTOCOL_TOPIC:
                    self._from_bridge(message)
                else:
                    self._put(open_envelope(message.payload))
            except (EnvelopeError, AnnouncementError) as error:
                log.warning("message-dropped source=%s topic=%s %s", message.source, message.topic, error)
            except zenoh.ZError as error:
                log.warning("zenoh-refused source=%s topic=%s %s", message.source, message.topic, error)
        elif header.get("event") in ("peer-online", "peer-restarted"):
            self.announce(str(header["peer"]))
            self._send_history(self._keeping_keys(), str(header["peer"]))
        elif header.get("event") == "peer-offline":
            with self._lock:
                self._apply(self._token_exchange.on_robot_gone(str(header["peer"])))

    def _put(self, sample: Envelope) -> None:
        with self._lock:
            kept = self._token_exchange.depth(sample.key) > 0
            is_new = not kept or self._deduplicator.is_new(sample.key, sample.attachment, sample.payload)
        # A sample the network duplicated is put twice, as it came; a cached sample sent again is not.
        if is_new or not sample.again:
            self._publishers.put(sample)

    def _from_bridge(self, message: Message) -> None:
        with self._lock:
            change, answer = self._token_exchange.on_announcement(message.source, message.payload)
            self._apply(change)
        if answer:
            self.announce(message.source)
            self._send_history(self._keeping_keys(), message.source)

    def _apply(self, change: TokenChange) -> None:
        live = self._session.liveliness()
        for token in change.declare:
            # The companion first, so that no bridge takes the token for one of its own side.
            companion = live.declare_token(carried_key(self._own, token))
            self._tokens[token] = (companion, live.declare_token(token))
        for token in change.withdraw:
            companion, copy = self._tokens.pop(token)
            copy.undeclare()
            companion.undeclare()
        self._publishers.withdraw_stale()

    def ensure_topic(self) -> None:
        """Declares the bridges' topic, which a restarted daemon may lack. Raises MeshError."""
        self._daemon.ensure_topics({PROTOCOL_TOPIC: PROTOCOL_TOPIC_SETTINGS})


def arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="udp_mesh.bridges.zenoh_bridge", description="Carry Zenoh over the mesh.")
    parser.add_argument("--socket", default=DEFAULT_SOCKET, help="the daemon's socket (default: %(default)s)")
    parser.add_argument("--config", help="Zenoh configuration file (JSON5)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=JSON", help="override a Zenoh setting")
    parser.add_argument(
        "--route",
        action="append",
        default=[],
        type=parse_route,
        metavar="KEYEXPR=TOPIC[@PEER,...]",
        help="carry samples under a key expression on a mesh topic (repeatable)",
    )
    parser.add_argument(
        "--ros2",
        action="append",
        default=[],
        type=parse_ros2_route,
        metavar="[DOMAIN:]/ros/topic=TOPIC[@PEER,...]",
        help="carry a ROS 2 topic of rmw_zenoh on a mesh topic (repeatable)",
    )
    parser.add_argument(
        "--receive",
        action="append",
        default=[],
        type=_receive,
        metavar="'TOPIC [rate_hz=HZ] [max_age_s=S]'",
        help="receive this topic or pattern, and no other; peers send nothing else (repeatable; default: all)",
    )
    return parser


def _receive(text: str) -> Receive:
    try:
        return parse_receive(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def main(argv: Sequence[str] | None = None) -> int:
    """Runs until SIGTERM or SIGINT."""
    options = arguments().parse_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s")
    try:
        config = zenoh.Config.from_file(options.config) if options.config else zenoh.Config()
        for setting in options.set:
            key, _, value = setting.partition("=")
            config.insert_json5(key, value)
        session = zenoh.open(config)
    except zenoh.ZError as error:
        sys.stderr.write("zenoh_bridge: {}\n".format(error))
        return 1
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with session:
        daemon = DaemonClient(options.socket, with_needed(options.receive, [PROTOCOL_TOPIC]))
        bridge = ZenohBridge(daemon, session, [*options.route, *options.ros2])
        bridge.start()
        thread = threading.Thread(target=daemon.run, args=(stop, bridge.on_daemon_up, bridge.on_frame), daemon=True)
        thread.start()
        while not stop.wait(REFRESH_S) and thread.is_alive():
            try:
                bridge.ensure_topic()
            except MeshError as error:
                log.debug("daemon-unreachable %s", error)
        if not stop.is_set():
            # The daemon client's thread failed and logged its exception; the supervisor restarts this process.
            return 1
        thread.join(5.0)
    return 0


if __name__ == "__main__":
    sys.exit(main())
