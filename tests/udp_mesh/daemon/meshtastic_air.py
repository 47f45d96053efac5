"""A stand-in for Meshtastic radios: the channel of `serial_air` behind ports that speak the firmware's stream protocol.

0x94 0xC3, length (2), ToRadio or FromRadio of Meshtastic's own protobufs. Each radio gives its configuration, reports
its queue, and passes packets to all others; encryption, hops and the firmware's repeats are not modeled.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

from meshtastic.protobuf import mesh_pb2
from meshtastic.protobuf.portnums_pb2 import PortNum

from tests.udp_mesh.daemon.serial_air import Port, SerialAir
from udp_mesh.core.thin.lora import MESHTASTIC_OVERHEAD_BYTES

START = b"\x94\xc3"


class MeshtasticAir(SerialAir):
    """`hop_limits` are those of the packets; `limited` are the ports whose radio refuses for its duty cycle."""

    overhead_bytes = MESHTASTIC_OVERHEAD_BYTES
    # The firmware listens before it sends.
    senses_carrier = True

    def __init__(self, count: int, *, bits_per_s: float) -> None:
        super().__init__(count, bits_per_s=bits_per_s)
        self.hop_limits: set[int] = set()
        self.limited: set[int] = set()

    def write(self, port: Port, message: mesh_pb2.FromRadio) -> None:
        os.write(port.master, self._line(message))

    def _taken(self, port: Port) -> Iterator[bytes]:
        line = port.line
        while (start := line.find(START)) >= 0:
            del line[:start]
            end = 4 + int.from_bytes(line[2:4], "big")
            if len(line) < max(4, end):
                return
            request = mesh_pb2.ToRadio.FromString(bytes(line[4:end]))
            del line[:end]
            if request.want_config_id:
                self._configure(port, request.want_config_id)
            elif request.HasField("packet"):
                yield from self._on_packet(port, request.packet)

    def _on_packet(self, port: Port, packet: mesh_pb2.MeshPacket) -> Iterator[bytes]:
        number = self.ports.index(port)
        status = mesh_pb2.QueueStatus(free=16, maxlen=16, mesh_packet_id=packet.id)
        self.write(port, mesh_pb2.FromRadio(queueStatus=status))
        if packet.decoded.portnum != PortNum.PRIVATE_APP:
            return
        assert packet.to == 0xFFFFFFFF
        assert not packet.want_ack
        if number in self.limited:
            routing = mesh_pb2.Routing(error_reason=mesh_pb2.Routing.Error.DUTY_CYCLE_LIMIT)
            self.write(port, self._received(number + 1, PortNum.ROUTING_APP, routing.SerializeToString(), packet.id))
            return
        self.hop_limits.add(packet.hop_limit)
        yield packet.decoded.payload

    def _configure(self, port: Port, request: int) -> None:
        number = 1 + self.ports.index(port)
        self.write(port, mesh_pb2.FromRadio(my_info=mesh_pb2.MyNodeInfo(my_node_num=number)))
        user = mesh_pb2.User(id=f"!{number:08x}", long_name=f"radio {number}", short_name=str(number))
        self.write(port, mesh_pb2.FromRadio(node_info=mesh_pb2.NodeInfo(num=number, user=user)))
        self.write(port, mesh_pb2.FromRadio(config_complete_id=request))

    def _written(self, frame: bytes) -> bytes:
        return self._line(self._received(99, PortNum.PRIVATE_APP, frame, 0))

    @staticmethod
    def _received(source: int, portnum: PortNum.ValueType, payload: bytes, request: int) -> mesh_pb2.FromRadio:
        data = mesh_pb2.Data(portnum=portnum, payload=payload, request_id=request)
        packet = mesh_pb2.MeshPacket(to=0xFFFFFFFF, decoded=data)
        setattr(packet, "from", source)
        return mesh_pb2.FromRadio(packet=packet)

    @staticmethod
    def _line(message: mesh_pb2.FromRadio) -> bytes:
        data: bytes = message.SerializeToString()
        return START + len(data).to_bytes(2, "big") + data
