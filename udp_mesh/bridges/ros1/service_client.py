"""A client of one call of a ROS 1 service, with a deadline, for requests and responses as bytes.

rospy's ServiceProxy waits as long as the server takes; here every read and write of the connection has a deadline. The
handshake is TCPROS's (http://wiki.ros.org/ROS/TCPROS): headers as `name=value` with lengths, then the request with its
length, and a byte that tells whether a response or an error text follows.
"""

from __future__ import annotations

import socket
import struct
import time
from io import BytesIO
from typing import Dict, NamedTuple, Tuple

from rosgraph.network import ROSHandshakeException, read_ros_handshake_header, write_ros_handshake_header

from udp_mesh.bridges.calls import MAY_HAVE_RUN

SCHEME = "rosrpc://"
HEADER_BYTES = 4096
_LENGTH = struct.Struct("<I")
MAX_RESPONSE_BYTES = 1 << 26
"""Maximum size of a server's response: the daemon's limit for messages."""


class ServiceType(NamedTuple):
    name: str
    md5sum: str


class ServiceError(RuntimeError):
    """There is no response; the text says why."""


def service_type(uri: str, name: str, caller: str, timeout_s: float) -> ServiceType:
    """The type of the service at `uri`, as its server reports it. Raises ServiceError."""
    with _Connection(uri, timeout_s) as connection:
        found = connection.shake_hands({"probe": "1", "md5sum": "*", "callerid": caller, "service": name})
    try:
        return ServiceType(found["type"], found["md5sum"])
    except KeyError as error:
        raise ServiceError("{}: the server does not report {}".format(name, error)) from error


def call_service(uri: str, name: str, md5sum: str, caller: str, request: bytes, timeout_s: float) -> bytes:
    """The response's bytes. Raises ServiceError."""
    with _Connection(uri, timeout_s) as connection:
        connection.shake_hands({"callerid": caller, "service": name, "md5sum": md5sum})
        connection.write(_LENGTH.pack(len(request)) + request)
        try:
            is_response = connection.read(1) == b"\1"
            (size,) = _LENGTH.unpack(connection.read(_LENGTH.size))
            if size > MAX_RESPONSE_BYTES:
                raise ServiceError("the response has {} bytes, more than {}".format(size, MAX_RESPONSE_BYTES))
            content = connection.read(size)
        except ServiceError as error:
            raise ServiceError("{}; {}".format(error, MAY_HAVE_RUN)) from error
    if not is_response:
        raise ServiceError(content.decode("utf-8", "replace"))
    return content


class _Connection:
    def __init__(self, uri: str, timeout_s: float) -> None:
        self._ends_at, self._timeout_s = time.monotonic() + timeout_s, timeout_s
        try:
            self._socket = socket.create_connection(_address(uri), timeout_s)
        except OSError as error:
            raise ServiceError("its server does not answer: {}".format(error)) from error

    def __enter__(self) -> _Connection:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def shake_hands(self, header: Dict[str, str]) -> Dict[str, str]:
        self._limit()
        try:
            write_ros_handshake_header(self._socket, header)
            found = read_ros_handshake_header(self._socket, BytesIO(), HEADER_BYTES)
        except (OSError, ROSHandshakeException, ValueError, struct.error) as error:
            raise ServiceError("its server ended the connection: {}".format(error)) from error
        if "error" in found:
            raise ServiceError(str(found["error"]))
        return {str(key): str(value) for key, value in found.items()}

    def write(self, data: bytes) -> None:
        self._limit()
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise ServiceError("its server ended the connection: {}".format(error)) from error

    def read(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            self._limit()
            try:
                part = self._socket.recv(min(size - len(data), 1 << 16))
            except socket.timeout as error:
                raise ServiceError(self._late()) from error
            except OSError as error:
                raise ServiceError("its server ended the connection: {}".format(error)) from error
            if not part:
                raise ServiceError("its server ended the connection without a response")
            data += part
        return bytes(data)

    def _limit(self) -> None:
        left_s = self._ends_at - time.monotonic()
        if left_s <= 0:
            raise ServiceError(self._late())
        self._socket.settimeout(left_s)

    def _late(self) -> str:
        return "no response from its server within {:g} s".format(self._timeout_s)


def _address(uri: str) -> Tuple[str, int]:
    host, _, port = uri[len(SCHEME) :].rstrip("/").rpartition(":")
    if not uri.startswith(SCHEME) or not host or not port.isdigit():
        raise ServiceError("expected {}HOST:PORT from the master, found {!r}".format(SCHEME, uri))
    return host.strip("[]"), int(port)
