"""The TCP connection below SSH, bound to the endpoint's interface if it has one."""

from __future__ import annotations

import errno
import socket
from pathlib import Path

from meshctl.device.connection import Deadlines, Endpoint
from meshctl.device.errors import Timeout, Unreachable


def open_socket(endpoint: Endpoint, limits: Deadlines) -> socket.socket:
    """A connected socket. Raises Timeout, Unreachable.

    With `endpoint.interface` it uses that interface whatever the routing table says (SO_BINDTODEVICE, socket(7);
    unprivileged since Linux 5.7), which distinguishes devices with the same address by the port they are plugged into.
    """
    try:
        sock = _connected(endpoint, limits.connect_s)
    except TimeoutError as error:
        raise Timeout(
            f"{endpoint.label}: no answer to connect within {limits.connect_s:g} s",
            phase="connect",
            hint=_reverse_path_hint(endpoint.interface),
        ) from error
    except OSError as error:
        raise Unreachable(
            f"{endpoint.label}: cannot connect: {error.strerror or error}", hint=_interface_hint(endpoint, error)
        ) from error
    # between commands keepalives want no reply, so the kernel has to notice missing acknowledgments
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 4 * limits.keepalive_s * 1000)
    return sock


def _connected(endpoint: Endpoint, timeout_s: float) -> socket.socket:
    if not endpoint.interface:
        return socket.create_connection((endpoint.host, endpoint.port), timeout=timeout_s)
    family, kind, protocol, _, address = socket.getaddrinfo(endpoint.host, endpoint.port, type=socket.SOCK_STREAM)[0]
    sock = socket.socket(family, kind, protocol)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, endpoint.interface.encode() + b"\0")
        sock.settimeout(timeout_s)
        sock.connect(address)
    except BaseException:
        sock.close()
        raise
    return sock


def _interface_hint(endpoint: Endpoint, error: OSError) -> str:
    name = endpoint.interface
    if not name:
        return ""
    match error.errno:
        case errno.ENODEV:
            return f"this machine has no interface {name}: `ip link` lists them"
        case errno.EPERM:
            return "binding to an interface needs Linux 5.7, or root"
        case errno.ENETUNREACH | errno.EHOSTUNREACH | errno.EADDRNOTAVAIL:
            return f"check the cable, and that {name} has an address in the same network: `ip addr show {name}`"
        case _:
            return ""


def _reverse_path_hint(interface: str) -> str:
    """Strict reverse path filtering drops packets on an interface the kernel would not have used (RFC 3704)."""
    if not interface:
        return ""
    values = []
    for name in ("all", interface):
        try:
            values.append(Path(f"/proc/sys/net/ipv4/conf/{name}/rp_filter").read_text(encoding="ascii").strip())
        except OSError:
            return ""
    # the larger of the two counts (Documentation/networking/ip-sysctl.rst)
    if max(values) != "1":
        return ""
    return f"answers may be filtered: `sysctl net.ipv4.conf.{interface}.rp_filter=2` allows them"
