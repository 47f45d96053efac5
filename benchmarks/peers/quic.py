"""QUIC by aioquic: one stream for all bulk, one stream for each urgent message."""

from __future__ import annotations

import asyncio
import datetime
import ssl
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aioquic.asyncio.client import connect
from aioquic.asyncio.protocol import QuicConnectionProtocol
from aioquic.asyncio.server import serve
from aioquic.quic.configuration import QuicConfiguration
from aioquic.quic.events import QuicEvent, StreamDataReceived
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from benchmarks.peers import PORT

# aioquic's send buffer above which `bulk` blocks
_BUFFER_BYTES = 400_000


def _configuration(is_client: bool, algorithm: str) -> QuicConfiguration:
    return QuicConfiguration(
        is_client=is_client, alpn_protocols=["benchmark"], congestion_control_algorithm=algorithm,
        max_datagram_size=1400, idle_timeout=60, max_stream_data=4 << 20, max_data=8 << 20,
    )  # fmt: skip


class _Sender:
    def __init__(self, protocol: QuicConnectionProtocol) -> None:
        self._protocol = protocol
        self._quic: Any = protocol._quic
        self._stream = self._quic.get_next_available_stream_id(is_unidirectional=True)
        self._quic.send_stream_data(self._stream, b"")

    async def bulk(self, data: bytes) -> None:
        self._quic.send_stream_data(self._stream, len(data).to_bytes(4, "little") + data)
        self._protocol.transmit()
        # aioquic does not report when its buffer drains
        while len(self._quic._streams[self._stream].sender._buffer) > _BUFFER_BYTES:  # noqa: ASYNC110
            await asyncio.sleep(0.002)

    async def urgent(self, data: bytes) -> None:
        stream = self._quic.get_next_available_stream_id(is_unidirectional=True)
        self._quic.send_stream_data(stream, len(data).to_bytes(4, "little") + data, end_stream=True)
        self._protocol.transmit()


@dataclass(frozen=True, slots=True)
class _Transport:
    algorithm: str

    @asynccontextmanager
    async def sender(self, address: str) -> AsyncIterator[_Sender]:
        configuration = _configuration(True, self.algorithm)
        configuration.verify_mode = ssl.CERT_NONE
        async with connect(address, PORT, configuration=configuration) as protocol:
            yield _Sender(protocol)

    @asynccontextmanager
    async def receiver(self, on_message: Callable[[bytes], None]) -> AsyncIterator[None]:
        class Receiver(QuicConnectionProtocol):  # type: ignore[misc, unused-ignore]
            def __init__(self, *arguments: Any, **named: Any) -> None:
                super().__init__(*arguments, **named)
                self._streams: dict[int, bytearray] = {}

            def quic_event_received(self, event: QuicEvent) -> None:
                if not isinstance(event, StreamDataReceived):
                    return
                held = self._streams.setdefault(event.stream_id, bytearray())
                held += event.data
                while len(held) >= 4 and len(held) >= 4 + (size := int.from_bytes(held[:4], "little")):
                    on_message(bytes(held[4 : 4 + size]))
                    del held[: 4 + size]
                if event.end_stream:
                    self._streams.pop(event.stream_id, None)

        configuration = _configuration(False, self.algorithm)
        with tempfile.TemporaryDirectory() as directory:
            configuration.load_cert_chain(*_certificate(Path(directory)))
        server = await serve("0.0.0.0", PORT, configuration=configuration, create_protocol=Receiver)
        try:
            yield
        finally:
            server.close()


def _certificate(directory: Path) -> tuple[Path, Path]:
    """A self-signed certificate for this run."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "benchmark")])
    today = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
        .serial_number(x509.random_serial_number()).not_valid_before(today - datetime.timedelta(days=1))
        .not_valid_after(today + datetime.timedelta(days=1)).sign(key, hashes.SHA256())
    )  # fmt: skip
    paths = directory / "certificate.pem", directory / "key.pem"
    paths[0].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    paths[1].write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return paths


def transport(variant: str) -> _Transport:
    return _Transport(variant)
