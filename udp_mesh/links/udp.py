"""One UDP socket: datagrams out in runs (segmentation offload), datagrams in in runs (receive offload), never waiting.

Out: consecutive datagrams of one size to one destination become one system call with UDP_SEGMENT (linux/udp.h); where
the kernel or a device refuses that, the socket falls back to one call per datagram and remembers it. In: one call may
return up to 64 datagrams of one sender, told apart by the size that UDP_GRO reports. Measured reasons stand in the
transport's fact sheet.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
from collections.abc import Callable, Sequence
from typing import Protocol, TypeAlias

from udp_mesh.links.attachments import Address, Attachment

SOL_UDP, UDP_SEGMENT, UDP_GRO = 17, 103, 104
SO_BINDTODEVICE, SO_RCVBUFFORCE, SO_TIMESTAMPNS = 25, 33, 35

MAX_SEGMENTS = 64
"""UDP_MAX_SEGMENTS of older kernels (newer take 128)."""
MAX_RUN_BYTES = 65_000
"""One run must fit one IP packet of 65,535 B before it is cut."""
RECEIVE_BUFFER_BYTES = 4 << 20
"""Kernel receive buffer: 30 ms of a gigabit, so that a busy core loses nothing; capped by net.core.rmem_max."""
SEND_BUFFER_BYTES = 1 << 20
"""Kernel send buffer: a few runs; what waits here is beyond the scheduler's reach, so no more."""
MAX_SEND_ERRORS = 256
"""Destinations and reasons told apart of what the kernel refuses: more than a team."""
_DATAGRAM_BYTES = 1 << 16
_INT = struct.Struct("=i")
_TIMESPEC = struct.Struct("@ll")
_ANCILLARY_BYTES = socket.CMSG_SPACE(4) + socket.CMSG_SPACE(_TIMESPEC.size)

Deliver: TypeAlias = Callable[[memoryview, Address, float], None]
"""Takes a datagram, its sender, and when the kernel took it in (seconds since 1970, 0.0 where it does not say)."""


class Outgoing(Protocol):
    """What is sent: the core's datagram. `destination` None means the link's broadcast address."""

    @property
    def destination(self) -> Address | None: ...
    @property
    def data(self) -> bytes: ...
    @property
    def urgent(self) -> bool: ...


class UdpLink:
    """The open socket of one attachment."""

    def __init__(self, attachment: Attachment, *, urgent_dscp: int = 0) -> None:
        """Raises OSError where the address or port is taken, or the device is not ours to use."""
        self.attachment = attachment
        self.segmentation = True
        """Whether runs are still handed to the kernel whole."""
        self.datagrams_lost_on_send = 0
        """Datagrams the kernel refused (unreachable, forbidden, device gone, too long)."""
        self.send_errors: dict[tuple[Address, int], int] = {}
        """The same by destination and errno, until whoever tells of it has cleared it."""
        self.system_calls = 0
        self._buffer = memoryview(bytearray(_DATAGRAM_BYTES))
        family = socket.AF_INET6 if ":" in attachment.address[0] else socket.AF_INET
        level, name = (
            (socket.IPPROTO_IP, socket.IP_TOS)
            if family == socket.AF_INET
            else (socket.IPPROTO_IPV6, socket.IPV6_TCLASS)
        )
        self._urgent = [(level, name, _INT.pack(urgent_dscp << 2))] if urgent_dscp else []
        self._socket = socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        try:
            self._configure()
        except OSError:
            self._socket.close()
            raise

    def _configure(self) -> None:
        own, attachment = self._socket, self.attachment
        own.setsockopt(socket.SOL_SOCKET, SO_BINDTODEVICE, attachment.device.encode() + b"\0")
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        # Without CAP_NET_ADMIN the buffer stays within net.core.rmem_max.
        with contextlib.suppress(PermissionError):
            own.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
        # When a datagram came, not when we found time for it: round trips measure the network, not this machine's load.
        own.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        if own.family == socket.AF_INET6:
            # IPv4 has a socket of its own; our own datagrams to all nodes need not come back.
            own.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            own.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_LOOP, 0)
        # Before Linux 5.0 datagrams come one by one.
        with contextlib.suppress(OSError):
            own.setsockopt(SOL_UDP, UDP_GRO, 1)
        if attachment.broadcast is not None:
            own.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            # Broadcasts reach only sockets bound to no address; the device keeps other interfaces' traffic out.
            own.bind(("", attachment.address[1]))
        else:
            own.bind(attachment.address)

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self, deliver: Deliver, limit: int, stop_after: float = float("inf")) -> int:
        """Hands up to about `limit` waiting datagrams to `deliver`; returns how many. Our own broadcasts are left out.

        One that came after `fresh_from` (seconds since 1970) is taken for the last: what came with it is left to the
        next look, since to ask for more that is not there costs as much as to receive.
        The bytes handed over are overwritten by the next call: who keeps them copies them.
        """
        count, buffer, own = 0, self._buffer, self.attachment.address
        receive = self._socket.recvmsg_into
        buffers = [buffer]
        while count < limit:
            try:
                size, ancillary, _, source = receive(buffers, _ANCILLARY_BYTES)
            except BlockingIOError:
                break
            except OSError:
                # A pending error of the socket (an ICMP answer, the device going down): reading it clears it.
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

    def send(self, datagrams: Sequence[Outgoing]) -> int:
        """Sends from the front; returns how many are done with (sent, or lost as on a radio). Fewer: the socket is
        full."""
        done, total = 0, len(datagrams)
        while done < total:
            first = datagrams[done]
            destination = first.destination or self.attachment.broadcast
            if destination is None:
                # A broadcast on a link of fixed neighbours: nobody to send it to.
                done += 1
                continue
            end = self._run_end(datagrams, done) if self.segmentation else done + 1
            sent = self._send_run(datagrams[done:end], destination)
            if sent is None:
                break
            done += sent
        return done

    def _run_end(self, datagrams: Sequence[Outgoing], start: int) -> int:
        """Where the run from `start` ends: same destination and urgency, equal sizes, the last one may be shorter."""
        first = datagrams[start]
        size, destination, urgent = len(first.data), first.destination, first.urgent
        end = start + 1
        limit = min(len(datagrams), start + MAX_SEGMENTS, start + max(1, MAX_RUN_BYTES // max(1, size)))
        while end < limit:
            following = datagrams[end]
            length = len(following.data)
            if following.destination != destination or following.urgent != urgent or length > size:
                break
            end += 1
            if length < size:
                break
        return end

    def _send_run(self, run: Sequence[Outgoing], destination: Address) -> int | None:
        """How many of the run are done with; None where the socket is full."""
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
            # An IPv4 address on an IPv6 socket, or the other way round: a peer not yet heard at its new address.
            number = errno.EAFNOSUPPORT if isinstance(error, socket.gaierror) else error.errno or errno.EIO
            if len(run) > 1 and number in (errno.EIO, errno.EINVAL, errno.EMSGSIZE, errno.EOPNOTSUPP):
                return self._send_unsegmented(run, destination, number)
            # Unreachable, forbidden, too long, the device gone: as lost as on a radio, and answered by the same means.
            self.datagrams_lost_on_send += len(run)
            if len(self.send_errors) < MAX_SEND_ERRORS or (destination, number) in self.send_errors:
                self.send_errors[destination, number] = self.send_errors.get((destination, number), 0) + len(run)
        return len(run)

    def _send_unsegmented(self, run: Sequence[Outgoing], destination: Address, number: int) -> int | None:
        lost_before, done = self.datagrams_lost_on_send, 0
        while done < len(run) and self._send_run([run[done]], destination) is not None:
            done += 1
        if number != errno.EMSGSIZE and self.datagrams_lost_on_send - lost_before < done:
            # What goes singly and not in a run: no segmentation on this device or path. (EMSGSIZE: one above the
            # path's MTU; and EINVAL is the answer of a route that swallows everything, too.)
            self.segmentation = False
        return done or None

    def close(self) -> None:
        self._socket.close()
