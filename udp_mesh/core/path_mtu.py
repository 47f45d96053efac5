"""The size of fragments on a peer's path: a change of the link's MTU, black holes, probes (DPLPMTUD, RFC 8899)."""

from udp_mesh.core.events import ExpiryReason, PathNarrowed
from udp_mesh.core.peers.session import Peer, Session
from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.sender.packetizer import build_mtu_probe
from udp_mesh.core.sender.path import Path, datagram_room
from udp_mesh.core.sender.pmtu import NARROWER_MTUS
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.state import State


def update_mtu(state: State, session: Session, mtu: int) -> None:
    """The link or the settings changed under a session's path: fit both, and what the path was found to carry."""
    path = session.path
    sender = session.peer.sender if session.peer is not None else None
    if sender is not None and sender.pmtu.narrowed_at is not None:
        mtu = min(mtu, path.mtu)
    before = path.mtu
    path.switch_to(path.link, path.address, mtu, state.settings.fragment_bytes)
    if sender is not None and session.peer is not None and mtu < before:
        refragment(sender, path, include_sent=False)
        state.ready[session.peer] = None


def refragment(sender: Sender, path: Path, *, include_sent: bool) -> None:
    """Restart messages whose fragments are larger than the path now carries.

    A message sent completely may have arrived completely, and under a new number it would arrive twice. It is restarted
    only with `include_sent`, when none of its large fragments get through anyway. Otherwise the kernel fragments what
    is too large for the link. The repair of a broadcast is given up: it has no other number, under which its receiver
    would not mistake the smaller fragments for some of the larger ones.
    """
    for message in list(sender.pending):
        if not include_sent and message.started and message.next_position >= message.fragments:
            continue
        if message.started and any(
            not there and _fragment_bytes(message, position) > path.fragment_bytes
            for position, there in enumerate(message.arrived)
        ):
            if message.accepted.broadcast_number is not None:
                sender.finish(message, ExpiryReason.REFUSED)
                continue
            sender.cancel(message)
            sender.resend_from_start(message)


def _fragment_bytes(message: OutgoingMessage, position: int) -> int:
    start, end = message.span(position)
    return end - start


def compare_sizes(state: State, peer: Peer, sender: Sender, session: Session, now: float) -> None:
    """While large datagrams are suspected to vanish: judge the pings of all sizes so far, and send the next ones."""
    sender.pmtu.comparisons.settle(now)
    update_pmtu(state, peer, sender, session, now)
    path, comparisons = session.path, sender.pmtu.comparisons
    if not comparisons.due(now):
        return
    rooms = {mtu: datagram_room(path.address, mtu, state.settings.fragment_bytes) for mtu in NARROWER_MTUS}
    sizes = {path.mtu: path.room_bytes} | {mtu: room for mtu, room in rooms.items() if room < path.room_bytes}
    if len(sizes) == 1 or not path.confirmed:
        sender.pmtu.reset()
        return
    tokens = {}
    for mtu, room in sizes.items():
        token = state.rng.getrandbits(64)
        tokens[token] = mtu
        state.outgoing.append(build_mtu_probe(sender, path, token, room))
    comparisons.on_sent(tokens, now, sender.congestion.capacity_packets_per_s())


def update_pmtu(state: State, peer: Peer, sender: Sender, session: Session, now: float) -> None:
    """Use smaller fragments if full ones do not get through, and larger ones again if a probe of that size does."""
    path, size = session.path, sender.pmtu
    info = state.links.get(path.link)
    fragment_bytes = state.settings.fragment_bytes
    rooms = {mtu: datagram_room(path.address, mtu, fragment_bytes) for mtu in NARROWER_MTUS}
    narrower = [mtu for mtu, room in rooms.items() if room < path.room_bytes]
    if size.is_black_hole(now) and narrower:
        arriving = size.comparisons.largest_arriving()
        while len(narrower) > 1 and arriving and narrower[0] > arriving:
            narrower.pop(0)
        path.switch_to(path.link, path.address, narrower.pop(0), fragment_bytes)
        size.on_narrowed(now)
        state.event_queue.emit(PathNarrowed(peer.name, path.mtu, path.fragment_bytes))
        refragment(sender, path, include_sent=True)
        state.ready[peer] = None
    size.large_bytes = rooms[narrower[0]] if narrower else float("inf")
    if size.narrowed_at is None or info is None:
        return
    if size.probe.confirmed_mtu > path.mtu:
        path.switch_to(path.link, path.address, min(size.probe.confirmed_mtu, info.mtu), fragment_bytes)
        size.reset()
    rooms = {mtu: room for mtu, room in rooms.items() if mtu < info.mtu}
    rooms[info.mtu] = datagram_room(path.address, info.mtu, fragment_bytes)
    larger = {room: mtu for mtu, room in rooms.items() if room > path.room_bytes}
    if not larger:
        size.narrowed_at = None
    elif (
        peer.online
        and path.confirmed
        and sender.state is not SendState.UNRESPONSIVE
        and size.probe.due(now, sender.loss.rate)
    ):
        for room, mtu in larger.items():
            token = state.rng.getrandbits(64)
            size.probe.on_probe_sent(token, mtu)
            state.outgoing.append(build_mtu_probe(sender, path, token, room))
