"""Cyclone DDS with the settings of `cyclone_dds.xml`: bulk and urgent are two topics, both reliable.

No `from __future__ import annotations` here: Cyclone DDS reads the fields of its types itself and needs them as types.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import DDSException, Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import sequence, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

_TOPICS = ("bulk", "urgent")
_MATCH_TIMEOUT_S = 30.0
# a full history refuses the sample: the Python binding waits with the interpreter locked, urgent messages included
_RETRY_S = 0.01


@dataclass
class Payload(IdlStruct, typename="Payload"):  # type: ignore[misc, call-arg, unused-ignore]
    data: sequence[uint8]


def _qos() -> Any:
    return Qos(Policy.Reliability.Reliable(max_blocking_time=0), Policy.History.KeepAll)


@dataclass(frozen=True, slots=True)
class _Sender:
    bulk_writer: Any
    urgent_writer: Any

    async def bulk(self, data: bytes) -> None:
        await _write(self.bulk_writer, data)

    async def urgent(self, data: bytes) -> None:
        await _write(self.urgent_writer, data)


async def _write(writer: Any, data: bytes) -> None:
    while True:
        try:
            writer.write(Payload(data))
            return
        except DDSException as failure:
            if failure.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
        await asyncio.sleep(_RETRY_S)


@dataclass(frozen=True, slots=True)
class _Transport:
    @asynccontextmanager
    async def sender(self, address: str) -> AsyncIterator[_Sender]:
        # the receiver is found by multicast; the address is for the other transports
        participant = DomainParticipant(0)
        writers = [DataWriter(participant, Topic(participant, name, Payload), qos=_qos()) for name in _TOPICS]
        async with asyncio.timeout(_MATCH_TIMEOUT_S):
            # matching can only be polled
            while not all(writer.get_matched_subscriptions() for writer in writers):  # noqa: ASYNC110
                await asyncio.sleep(0.05)
        yield _Sender(*writers)

    @asynccontextmanager
    async def receiver(self, on_message: Callable[[bytes], None]) -> AsyncIterator[None]:
        class Arrival(Listener):  # type: ignore[misc, unused-ignore]
            def on_data_available(self, reader: Any) -> None:
                for sample in reader.take(64):
                    # without data: the sender has ended
                    if isinstance(sample, Payload):
                        on_message(bytes(sample.data))

        participant = DomainParticipant(0)
        readers = [
            DataReader(participant, Topic(participant, name, Payload), qos=_qos(), listener=Arrival())
            for name in _TOPICS
        ]
        yield
        del readers


def transport(variant: str) -> _Transport:
    assert variant == "reliable"
    return _Transport()
