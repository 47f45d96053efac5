"""The UDP sockets of one attachment: send and receive datagrams in runs (segmentation, receive offload), never block.

Send: consecutive datagrams of one size to one destination become one system call with UDP_SEGMENT (linux/udp.h). If the
kernel or a device refuses that, the socket falls back to one call per datagram for good. Receive: one call may return
up to 64 datagrams of one sender, split by the size in UDP_GRO. Measurements are in the transport's fact sheet.

Three sockets share the port (SO_REUSEPORT, `source_filter`): one receives what known peers mark as urgent, one what
else they send, one what strangers send. Each has a queue of its own, so that the others can be read less often.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias

from udp_mesh.links.attachments import Address, Attachment
from udp_mesh.links.source_filter import (
    ACCEPT,
    DROP,
    MARKED,
    SO_ATTACH_FILTER,
    SO_ATTACH_REUSEPORT_CBPF,
    STRANGERS,
    UNMARKED,
    attach,
    source_program,
)

SOL_UDP, UDP_SEGMENT, UDP_GRO = 17, 103, 104
SO_REUSEPORT, SO_BINDTODEVICE, SO_RCVBUFFORCE, SO_TIMESTAMPNS = 15, 25, 33, 35
IP_MTU_DISCOVER, IPV6_MTU_DISCOVER, PMTUDISC_OMIT = 10, 23, 5

MAX_SEGMENTS = 64
"""UDP_MAX_SEGMENTS of older kernels (newer ones allow 128)."""
MAX_RUN_BYTES = 65_000
"""A run must fit one IP packet of 65,535 B before segmentation."""
RECEIVE_BUFFER_BYTES = 4 << 20
"""Kernel receive buffer: 30 ms at a gigabit, so that a busy core loses nothing; capped by net.core.rmem_max."""
STRANGERS_BUFFER_BYTES = 1 << 18
"""That of the strangers' socket: some hundred datagrams, so that a flood leaves no long queue behind."""
SEND_BUFFER_BYTES = 1 << 20
"""Kernel send buffer: a few runs. The scheduler cannot reorder what is in it, so it is small."""
MAX_SEND_ERRORS = 256
"""Distinct (destination, errno) pairs counted for send errors: more than a team."""
_DATAGRAM_BYTES = 1 << 16
_INT = struct.Struct("=i")
_TIMESPEC = struct.Struct("@ll")
_ANCILLARY_BYTES = socket.CMSG_SPACE(4) + socket.CMSG_SPACE(_TIMESPEC.size)

Deliver: TypeAlias = Callable[[memoryview, Address, float], None]
"""Called with a datagram, its sender, and its kernel timestamp (seconds since 1970; 0.0 if there is none)."""


class OutgoingDatagram(Protocol):
    """A datagram of the core. `destination` None means the link's broadcast address."""

    @property
    def destination(self) -> Address | None: ...
    @property
    def data(self) -> bytes: ...
    @property
    def urgent(self) -> bool: ...


class UdpLink:
    """The open socket of one attachment."""

    def __init__(self, attachment: Attachment, *, urgent_dscp: int = 0) -> None:
        """Raises OSError if the address or port is in use, or the device may not be used."""
        self.attachment = attachment
        self.segmentation = True
        """Whether segmentation offload is in use."""
        self.datagrams_lost_on_send = 0
        """Datagrams the kernel refused (unreachable, prohibited, device gone, too long)."""
        self.send_errors: dict[tuple[Address, int], int] = {}
        """The same by destination and errno, until the caller clears it."""
        self.system_calls = 0
        self._buffer = memoryview(bytearray(_DATAGRAM_BYTES))
        family = socket.AF_INET6 if ":" in attachment.address[0] else socket.AF_INET
        level, name = (
            (socket.IPPROTO_IP, socket.IP_TOS)
            if family == socket.AF_INET
            else (socket.IPPROTO_IPV6, socket.IPV6_TCLASS)
        )
        self._urgent = [(level, name, _INT.pack(urgent_dscp << 2))] if urgent_dscp else []
        self.peers: frozenset[Address] = frozenset()
        """The senders whose datagrams arrive at the first two sockets."""
        # Bound in the order of `STRANGERS`, `MARKED` and `UNMARKED`. The first one shares the port only afterwards, so
        # it fails if another process has it, or is opening it right now.
        self._strangers = self._open(family, STRANGERS_BUFFER_BYTES, share=False)
        try:
            self._strangers.setsockopt(socket.SOL_SOCKET, SO_REUSEPORT, 1)
            self._socket = self._open(family, RECEIVE_BUFFER_BYTES)
            try:
                self._unmarked = self._open(family, RECEIVE_BUFFER_BYTES)
            except OSError:
                self._socket.close()
                raise
        except OSError:
            self._strangers.close()
            raise
        try:
            self._attach(self.peers)
            self._sorts = True
        except OSError:
            # A kernel before Linux 4.5, or a sandbox: one socket receives everything.
            self._sorts = False
            self._socket.close()
            self._unmarked.close()
            self._socket = self._unmarked = self._strangers

    def _open(self, family: int, buffer_bytes: int, *, share: bool = True) -> socket.socket:
        """A configured and bound socket."""
        own = socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        try:
            if share:
                own.setsockopt(socket.SOL_SOCKET, SO_REUSEPORT, 1)
            self._configure(own, buffer_bytes)
        except OSError:
            own.close()
            raise
        return own

    def set_peers(self, peers: frozenset[Address]) -> bool:
        """Receive from these senders at the first two sockets, from all others at the strangers'. False if the kernel
        refused the programs: then everything arrives as from strangers."""
        if not self._sorts or peers == self.peers:
            return self._sorts
        try:
            self._attach(peers)
        except OSError:
            # Too little option memory (net.core.optmem_max).
            self._attach(frozenset())
            self.peers = frozenset()
            return False
        self.peers = peers
        return True

    def _attach(self, peers: frozenset[Address]) -> None:
        """Attach the programs in an order in which no datagram is refused by all sockets."""
        self._attach_filters(self.peers | peers, not_strangers=self.peers & peers)
        to_group = source_program(peers, self._socket.family, MARKED, UNMARKED, STRANGERS)
        attach(self._socket, SO_ATTACH_REUSEPORT_CBPF, to_group)
        self._attach_filters(peers, not_strangers=peers)

    def _attach_filters(self, peers: frozenset[Address], *, not_strangers: frozenset[Address]) -> None:
        """The sockets for peers accept these senders; the one for strangers refuses `not_strangers`."""
        family = self._socket.family
        attach(self._socket, SO_ATTACH_FILTER, source_program(peers, family, ACCEPT, DROP, DROP))
        attach(self._unmarked, SO_ATTACH_FILTER, source_program(peers, family, DROP, ACCEPT, DROP))
        attach(self._strangers, SO_ATTACH_FILTER, source_program(not_strangers, family, DROP, DROP, ACCEPT))

    def _configure(self, own: socket.socket, buffer_bytes: int) -> None:
        attachment = self.attachment
        own.setsockopt(socket.SOL_SOCKET, SO_BINDTODEVICE, attachment.device.encode() + b"\0")
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        # Without CAP_NET_ADMIN, net.core.rmem_max limits the buffer.
        with contextlib.suppress(PermissionError):
            own.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, buffer_bytes)
        # The arrival time rather than the time of reading: round trips must measure the network, not this machine.
        own.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        # Anyone can forge an ICMP error that makes the kernel cut our datagrams into IP packets of 552 bytes for ten
        # minutes, of which some networks drop all. The core finds the path MTU by what arrives (`core.sender.pmtu`).
        # IP_PMTUDISC_INTERFACE ignores these errors as well, but refuses what was cut for a link before its MTU shrank.
        if own.family == socket.AF_INET:
            own.setsockopt(socket.IPPROTO_IP, IP_MTU_DISCOVER, PMTUDISC_OMIT)
        else:
            own.setsockopt(socket.IPPROTO_IPV6, IPV6_MTU_DISCOVER, PMTUDISC_OMIT)
            # IPv4 has a socket of its own, and our own multicasts need not come back.
            own.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            own.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_LOOP, 0)
        # Not available before Linux 5.0: datagrams then arrive one by one.
        with contextlib.suppress(OSError):
            own.setsockopt(SOL_UDP, UDP_GRO, 1)
        if attachment.broadcast is not None:
            own.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            # Only an unbound address receives broadcasts; the device keeps other interfaces' traffic out.
            own.bind(("", attachment.address[1]))
        else:
            own.bind(attachment.address)

    def fileno(self) -> int:
        """The socket of what known peers mark as urgent; also used to send."""
        return self._socket.fileno()

    def unmarked_fileno(self) -> int:
        return self._unmarked.fileno()

    def strangers_fileno(self) -> int:
        return self._strangers.fileno()

    def receive(self, deliver: Deliver, limit: int, stop_after: float = float("inf")) -> int:
        """`_receive` what known peers mark as urgent."""
        return self._receive(self._socket, deliver, limit, stop_after)

    def receive_unmarked(self, deliver: Deliver, limit: int, stop_after: float = float("inf")) -> int:
        """`_receive` what else known peers send."""
        return self._receive(self._unmarked, deliver, limit, stop_after)

    def receive_from_strangers(self, deliver: Deliver, limit: int, stop_after: float = float("inf")) -> int:
        """`_receive` from all others."""
        return self._receive(self._strangers, deliver, limit, stop_after)

    def _receive(self, from_socket: socket.socket, deliver: Deliver, limit: int, stop_after: float) -> int:
        """Passes about `limit` waiting datagrams to `deliver`, except our own broadcasts; returns their number.

        Stops after a datagram that arrived after `stop_after` (seconds since 1970), which is taken to be the last one:
        another read would cost as much as a datagram. The buffer passed is overwritten by the next call: the callee
        must copy what it keeps.
        """
        count, buffer, own = 0, self._buffer, self.attachment.address
        receive = from_socket.recvmsg_into
        buffers = [buffer]
        while count < limit:
            try:
                size, ancillary, _, source = receive(buffers, _ANCILLARY_BYTES)
            except BlockingIOError:
                break
            except OSError:
                # A pending socket error (an ICMP error, the device going down): reading it clears it.
                break
            self.system_calls += 1
            address = (source[0], source[1])
            if address == own:
                continue
            segment, arrived = size, 0.0
            for level, kind, data in ancillary:
                if level == SOL_UDP and kind == UDP_GRO:
                    segment = _INT.unpack_from(data)[0]
                elif kind == SO_TIMESTAMPNS:
                    seconds, nanoseconds = _TIMESPEC.unpack_from(data)
                    arrived = seconds + nanoseconds * 1e-9
            if size <= segment:
                deliver(buffer[:size], address, arrived)
                count += 1
                if arrived > stop_after:
                    break
                continue
            for start in range(0, size, segment):
                deliver(buffer[start : min(start + segment, size)], address, arrived)
                count += 1
        return count

    def send(self, datagrams: Sequence[OutgoingDatagram]) -> int:
        """Sends from the front; returns how many are done (sent or lost). Fewer than all means the socket is full."""
        done, total = 0, len(datagrams)
        while done < total:
            first = datagrams[done]
            destination = first.destination or self.attachment.broadcast
            if destination is None:
                # A broadcast on a link with fixed neighbors only: there is no destination.
                done += 1
                continue
            end = self._run_end(datagrams, done) if self.segmentation else done + 1
            sent = self._send_run(datagrams[done:end], destination)
            if sent is None:
                break
            done += sent
        return done

    def _run_end(self, datagrams: Sequence[OutgoingDatagram], start: int) -> int:
        """The end of the run from `start`: same destination and urgency, same size; the last one may be shorter.

        In an urgent run it may not: probes of several sizes are sent together, and a router may drop a run for its
        largest datagram before it is segmented.
        """
        first = datagrams[start]
        size, destination, urgent = len(first.data), first.destination, first.urgent
        end = start + 1
        limit = min(len(datagrams), start + MAX_SEGMENTS, start + max(1, MAX_RUN_BYTES // max(1, size)))
        while end < limit:
            following = datagrams[end]
            length = len(following.data)
            if following.destination != destination or following.urgent != urgent:
                break
            if length > size or (urgent and length != size):
                break
            end += 1
            if length < size:
                break
        return end

    def _send_run(self, run: Sequence[OutgoingDatagram], destination: Address) -> int | None:
        """The number of datagrams of the run that are done; None if the socket is full."""
        ancillary = list(self._urgent) if run[0].urgent else []
        if len(run) > 1:
            ancillary.append((SOL_UDP, UDP_SEGMENT, struct.pack("=H", len(run[0].data))))
        try:
            self.system_calls += 1
            if ancillary:
                self._socket.sendmsg([datagram.data for datagram in run], ancillary, 0, destination)
            else:
                self._socket.sendto(run[0].data, destination)
        except BlockingIOError:
            return None
        except OSError as error:
            # An IPv4 address on an IPv6 socket or vice versa: a peer not yet heard at its new address.
            number = errno.EAFNOSUPPORT if isinstance(error, socket.gaierror) else error.errno or errno.EIO
            if len(run) > 1 and number in (errno.EIO, errno.EINVAL, errno.EMSGSIZE, errno.EOPNOTSUPP):
                return self._send_unsegmented(run, destination, number)
            # Unreachable, prohibited, too long, device gone: treated like a loss on the radio.
            self.datagrams_lost_on_send += len(run)
            if len(self.send_errors) < MAX_SEND_ERRORS or (destination, number) in self.send_errors:
                self.send_errors[destination, number] = self.send_errors.get((destination, number), 0) + len(run)
        return len(run)

    def _send_unsegmented(self, run: Sequence[OutgoingDatagram], destination: Address, number: int) -> int | None:
        lost_before, done = self.datagrams_lost_on_send, 0
        while done < len(run) and self._send_run([run[done]], destination) is not None:
            done += 1
        if number != errno.EMSGSIZE and self.datagrams_lost_on_send - lost_before < done:
            # Works one by one but not as a run: no segmentation on this device or path. (EMSGSIZE: one datagram exceeds
            # the path MTU. EINVAL is also the error of a blackhole route.)
            self.segmentation = False
        return done or None

    def close(self) -> None:
        self._socket.close()
        self._unmarked.close()
        self._strangers.close()
