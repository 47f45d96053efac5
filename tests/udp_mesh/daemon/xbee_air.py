"""A stand-in for XBee radios: the channel of `serial_air` behind ports that speak API frames, built by Digi's library.

Each radio sends the data of a Transmit Request to all others, reports its Transmit Status, and refuses what is larger
than its NP, as the guide of the real ones describes. Addresses, networks and retries are not modeled.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

from digi.xbee.models.address import XBee16BitAddress, XBee64BitAddress
from digi.xbee.models.mode import OperatingMode
from digi.xbee.models.status import TransmitStatus
from digi.xbee.packets.base import XBeePacket
from digi.xbee.packets.common import ReceivePacket, TransmitPacket, TransmitStatusPacket
from digi.xbee.packets.factory import build_frame

from tests.udp_mesh.daemon.serial_air import Port, SerialAir
from udp_mesh.wire.xbee import AIR_OVERHEAD_BYTES


class XBeeAir(SerialAir):
    """Radios with AP=1, or with AP=2 if `escaped`; `np` is their largest payload."""

    overhead_bytes = AIR_OVERHEAD_BYTES
    # IEEE 802.15.4's CSMA-CA. Without it, frames that this process reads late would collide, whenever written.
    senses_carrier = True

    def __init__(self, count: int, *, bits_per_s: float, escaped: bool, np: int = 256) -> None:
        super().__init__(count, bits_per_s=bits_per_s)
        self.escaped, self.np = escaped, np
        self.refused = 0
        self._mode = OperatingMode.ESCAPED_API_MODE if escaped else OperatingMode.API_MODE

    def _taken(self, port: Port) -> Iterator[bytes]:
        while (request := self._request(port)) is not None:
            assert request.x64bit_dest_addr == XBee64BitAddress.BROADCAST_ADDRESS
            data = bytes(request.rf_data)
            fits = len(data) <= self.np
            self.refused += not fits
            if request.frame_id:
                status = TransmitStatus.SUCCESS if fits else TransmitStatus.PAYLOAD_TOO_LARGE
                unknown = XBee16BitAddress.UNKNOWN_ADDRESS
                os.write(port.master, self._line(TransmitStatusPacket(request.frame_id, unknown, 0, status)))
            if fits:
                yield data

    def _request(self, port: Port) -> TransmitPacket | None:
        """The next complete request; Digi's library raises for one that is wrong."""
        line = port.line
        if not line:
            return None
        assert line[0] == 0x7E, bytes(line)
        plain = XBeePacket.unescape_data(line) if self.escaped else line
        size = 3 + int.from_bytes(plain[1:3], "big") + 1
        if len(plain) < max(4, size) or (self.escaped and line[-1] == XBeePacket.ESCAPE_BYTE):
            return None
        raw = line[:size]
        while self.escaped and len(XBeePacket.unescape_data(raw)) < size:
            raw = line[: len(raw) + 1]
        del line[: len(raw)]
        packet = build_frame(XBeePacket.unescape_data(raw) if self.escaped else raw, self._mode)
        assert isinstance(packet, TransmitPacket)
        return packet

    def _written(self, frame: bytes) -> bytes:
        source = XBee64BitAddress.from_hex_string("0013A20040A1B2C3")
        return self._line(ReceivePacket(source, XBee16BitAddress.UNKNOWN_ADDRESS, 0x02, bytearray(frame)))

    def _line(self, packet: XBeePacket) -> bytes:
        return bytes(packet.output(escaped=self.escaped))
