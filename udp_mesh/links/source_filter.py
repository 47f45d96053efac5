"""Classic BPF programs that tell known senders from strangers in the kernel, by source address and port, and what the
former mark as urgent from what they do not, by DSCP.

A flood then fills the strangers' socket only, and bulk can be read less often than what is urgent. The programs are
attached to sockets (SO_ATTACH_FILTER) and to their group (SO_ATTACH_REUSEPORT_CBPF); neither needs a privilege.
"""

from __future__ import annotations

import ctypes
import ipaddress
import socket
import struct
from collections.abc import Iterable

from udp_mesh.links.attachments import Address

SO_ATTACH_FILTER, SO_ATTACH_REUSEPORT_CBPF = 26, 51

MAX_INSTRUCTIONS = 1500
"""The kernel charges programs to net.core.optmem_max, 20 KiB on older kernels. About 250 IPv4 senders fit; further ones
are treated as strangers."""

ACCEPT, DROP = 0xFFFFFFFF, 0
STRANGERS, MARKED, UNMARKED = 0, 1, 2
"""Positions in the group: the order in which the sockets were bound."""

_LOAD_WORD, _LOAD_HALF, _JUMP_EQUAL, _RETURN = 0x20, 0x28, 0x15, 0x06
_AND, _LOAD_X, _X_TO_A, _RETURN_A = 0x54, 0x01, 0x87, 0x16
_NETWORK_HEADER = 0xFFF00000
"""SKF_NET_OFF: offsets from here are relative to the IP header."""
_SOURCE_OFFSET: dict[int, int] = {socket.AF_INET: 12, socket.AF_INET6: 8}
_DSCP_MASK: dict[int, int] = {socket.AF_INET: 0x00FC, socket.AF_INET6: 0x0FC0}
"""In the first two bytes of the IP header."""
_PORT_OFFSET: dict[int, int] = {socket.AF_INET: 20, socket.AF_INET6: 40}
"""Without IP options, which no node sends."""
_INSTRUCTION = struct.Struct("=HBBI")
_PROGRAM = struct.Struct("@HP")


def source_program(sources: Iterable[Address], family: int, marked: int, unmarked: int, unknown: int) -> bytes:
    """The instructions that return `marked` or `unmarked` for datagrams of these senders, with and without a DSCP, and
    `unknown` for all others."""
    instructions: list[tuple[int, int, int, int]] = [
        (_LOAD_HALF, 0, 0, _NETWORK_HEADER),
        (_AND, 0, 0, _DSCP_MASK[family]),
        (_LOAD_X, 0, 0, unmarked),
        (_JUMP_EQUAL, 1, 0, 0),
        (_LOAD_X, 0, 0, marked),
    ]
    for host, port in sorted(sources):
        block = _match(host, port, family)
        if len(instructions) + len(block) >= MAX_INSTRUCTIONS:
            break
        instructions += block
    instructions.append((_RETURN, 0, 0, unknown))
    return b"".join([_INSTRUCTION.pack(*instruction) for instruction in instructions])


def _match(host: str, port: int, family: int) -> list[tuple[int, int, int, int]]:
    """Compare the address word by word, then the port, and return X; continue after this block if one differs."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if address.version != (4 if family == socket.AF_INET else 6):
        return []
    words = [(_LOAD_WORD, offset, value) for offset, (value,) in enumerate(struct.iter_unpack(">I", address.packed))]
    loads = [(code, _SOURCE_OFFSET[family] + 4 * place, value) for code, place, value in words]
    loads.append((_LOAD_HALF, _PORT_OFFSET[family], port))
    block: list[tuple[int, int, int, int]] = []
    for place, (code, offset, value) in enumerate(loads):
        rest = 2 * (len(loads) - place)
        block += [(code, 0, 0, _NETWORK_HEADER + offset), (_JUMP_EQUAL, 0, rest, value)]
    return [*block, (_X_TO_A, 0, 0, 0), (_RETURN_A, 0, 0, 0)]


def attach(own: socket.socket, option: int, program: bytes) -> None:
    """Attach a program, replacing the one before it. Raises OSError."""
    buffer = ctypes.create_string_buffer(program, len(program))
    header = _PROGRAM.pack(len(program) // _INSTRUCTION.size, ctypes.addressof(buffer))
    own.setsockopt(socket.SOL_SOCKET, option, header)
