"""The configurations of docs/how-to/permanent-sites.md, run: TLS, operators with nkeys, sites that delete nothing."""

from __future__ import annotations

import datetime
import ipaddress
import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from meshctl.errors import InputError
from meshctl.sites.nats_client import NatsClient, NatsServer
from meshctl.sites.nats_errors import NatsLost
from meshctl.sites.subjects import SiteSubjects, stream_settings
from tests.meshctl.monitor.prometheus_program import free_tcp_port
from tests.meshctl.sites.nats_servers import PROGRAM
from tests.waiting import until

pytestmark = [pytest.mark.xdist_group("nats")]
PAGE = Path(__file__).parents[3] / "docs/how-to/permanent-sites.md"
_NORTH = SiteSubjects("mines", "north")
_LIMITS = stream_settings(1, 1 << 20)


def _certificate(directory: Path) -> tuple[Path, Path]:
    """A certificate of this computer that is its own authority, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "hub")])
    address = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(address, critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    form = serialization.PrivateFormat.PKCS8
    certificate, private = directory / "hub.pem", directory / "hub.key"
    certificate.write_bytes(made.public_bytes(serialization.Encoding.PEM))
    private.write_bytes(key.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption()))
    return certificate, private


def _new_nkey(path: Path) -> str:
    """A new key of an operator, as `nk -gen user` makes it; returns its public part."""
    import nkeys

    seed = nkeys.encode_seed(os.urandom(32), nkeys.PREFIX_BYTE_USER)
    path.write_bytes(seed)
    return str(nkeys.from_seed(bytearray(seed)).public_key.decode())


class Servers:
    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.ca, private = _certificate(directory)
        self.clients, self.leaf, remote = free_tcp_port(), free_tcp_port(), free_tcp_port()
        self.operator = directory / "operator.nk"
        hub, leaf = re.findall(r"```\n# /etc/nats-server.conf\n(.*?)```", PAGE.read_text(), re.DOTALL)
        hub = re.sub(r"nkey: \w+", f"nkey: {_new_nkey(self.operator)}", hub)
        hub = hub.replace("0.0.0.0:4222", f"127.0.0.1:{self.clients}").replace("0.0.0.0:7422", f"127.0.0.1:{remote}")
        hub = hub.replace("/etc/nats/hub.pem", str(self.ca)).replace("/etc/nats/hub.key", str(private))
        password = re.search(r'password: "([^"]+)"', hub)
        assert password is not None
        # a URL has no spaces
        hub = hub.replace(password[1], "long-random")
        leaf = leaf.replace("PASSWORD@hub.example.org:7422", f"long-random@127.0.0.1:{remote}")
        leaf = leaf.replace("127.0.0.1:4222", f"127.0.0.1:{self.leaf}").replace("/etc/nats/ca.pem", str(self.ca))
        self._processes = [self._start("hub", hub), self._start("leaf", leaf)]

    def _start(self, name: str, config: str) -> subprocess.Popen[bytes]:
        path = self.directory / f"{name}.conf"
        path.write_text(config.replace("/var/lib/nats", str(self.directory / name)))
        log = self.directory / f"{name}.log"
        with log.open("wb") as file:
            process = subprocess.Popen([PROGRAM, "-c", str(path)], stdout=file, stderr=file)
        until(lambda: "Server is ready" in log.read_text(), f"a server in {log}", wait_s=60)
        return process

    def at_hub(self, credentials: Path | None, ca: Path | None) -> NatsClient:
        return NatsClient(NatsServer(f"tls://127.0.0.1:{self.clients}", credentials, ca))

    def at_leaf(self) -> NatsClient:
        return NatsClient(NatsServer(f"nats://127.0.0.1:{self.leaf}"))

    def stop(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Servers]:
    started = Servers(tmp_path_factory.mktemp("nats"))
    yield started
    started.stop()


def test_orders_and_events_pass_and_a_site_cannot_delete_orders(servers: Servers) -> None:
    operator, site = servers.at_hub(servers.operator, servers.ca), servers.at_leaf()
    operator.ensure_stream(name=_NORTH.order_stream, subjects=[_NORTH.orders], retention="workqueue", **_LIMITS)
    site.ensure_stream(name=_NORTH.run_stream, subjects=[_NORTH.runs], **_LIMITS)
    operator.ensure_mirror(_NORTH.run_stream, "north", **_LIMITS)
    operator.store(_NORTH.order("1"), "1-a", b"order")

    async def delete() -> None:
        await site._client.request(f"$JS.hub.API.STREAM.DELETE.{_NORTH.order_stream}", b"", timeout=2)

    with pytest.raises(NatsLost):
        site._run(delete())
    taken = next(site.work(_NORTH.order_stream, _NORTH.orders, "hub", "worker"))
    assert taken.chunk.data == b"order"
    taken.acknowledge()
    until(lambda: operator.queued(_NORTH.order_stream, _NORTH.order("1")) == 0, "the order to be taken", wait_s=30)
    site.store(_NORTH.run("1"), "1-0", b"event")
    with closing(operator.read(_NORTH.run_stream, _NORTH.run("1"), lambda: False)) as read:
        assert next(data for data in read if data is not None) == b"event"
    operator.close()
    site.close()


def test_a_file_that_has_no_credentials_is_named(servers: Servers, tmp_path: Path) -> None:
    file = tmp_path / "operator.nk"
    with pytest.raises(InputError, match=r"operator.nk: cannot be read"):
        servers.at_hub(file, servers.ca)
    file.write_text("password\n")
    with pytest.raises(InputError, match=r"expected a .creds file or the seed"):
        servers.at_hub(file, servers.ca)


@pytest.mark.parametrize(("has_key", "has_ca"), [(False, True), (True, False)])
def test_only_an_operator_with_a_key_at_a_known_hub_is_connected(servers: Servers, has_key: bool, has_ca: bool) -> None:
    with pytest.raises(NatsLost, match="NATS server tls://"):
        servers.at_hub(servers.operator if has_key else None, servers.ca if has_ca else None)
