"""Credentials that lack a permission at a real hub: what is refused is named, and no order is lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import closing, suppress
from itertools import islice
from pathlib import Path

import pytest

from meshctl.device.trust import TrustStore
from meshctl.errors import ExitCode
from meshctl.inventory import load_fleet
from meshctl.nodes.connections import ConnectionPool
from meshctl.sites.nats_client import NatsClient, NatsServer
from meshctl.sites.nats_errors import NatsLost
from meshctl.sites.nats_uplink import NatsUplink
from meshctl.sites.runs import SiteDirectory
from meshctl.sites.subjects import SiteSubjects, stream_settings
from tests.meshctl.device.servers import keypair, public
from tests.meshctl.monitor.prometheus_program import free_tcp_port
from tests.meshctl.sites.nats_servers import NatsServerProcess
from tests.waiting import until

pytestmark = [pytest.mark.xdist_group("nats")]
_NORTH = SiteSubjects("mines", "north")
_DENIED = (_NORTH.ask, "$JS.API.STREAM.CREATE.>", "_INBOX.refused.>")
INVENTORY = """\
meshctl: 1
fleet: mines
country: US
operators: {{ssh_keys: ["{key}"]}}
nats: {{url: {hub}}}
sites: {{north: {{nats: {{}}, ssh: {{key_files: ["{private}"]}}, worker_key: {worker}}}}}
nodes: {{}}
"""


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[NatsServerProcess]:
    permissions = {"publish": {"deny": list(_DENIED)}, "subscribe": {"deny": ["meshctl.>"]}}
    user = {"user": "operator", "password": "p", "permissions": permissions}
    accounts = {"MESH": {"jetstream": "enabled", "users": [user]}}
    server = NatsServerProcess(tmp_path / "hub", "hub", "hub", {"accounts": accounts, "no_auth_user": "operator"})
    yield server
    server.stop()


def test_a_request_that_is_not_permitted_is_named_instead_of_a_silent_site(
    hub: NatsServerProcess, tmp_path: Path
) -> None:
    private = keypair(tmp_path / "operator")
    key = public(private).read_text().strip()
    worker = SiteDirectory.of("mines/north", {"XDG_STATE_HOME": str(tmp_path)}).install([key])
    path = tmp_path / "fleet.yaml"
    path.write_text(INVENTORY.format(key=key, hub=hub.url, private=private, worker=worker))
    fleet = load_fleet(path)
    access = ConnectionPool(fleet, TrustStore(tmp_path / "known_hosts"), use_agent=False)
    with pytest.raises(NatsLost, match=f'permissions violation for publish to "{_NORTH.ask}"') as raised:
        NatsUplink(fleet, fleet.sites["north"], access)
    assert "permanent-sites.md" in raised.value.hint


def test_a_worker_that_its_leaf_node_no_longer_accepts_ends(tmp_path: Path) -> None:
    """nats-py ends such a connection for good: the worker would stay, and be silent, also once the credentials are
    right again. Its unit starts another one."""
    environ = {**os.environ, "XDG_STATE_HOME": str(tmp_path)}
    site = SiteDirectory.of("mines/north", environ)
    site.install([public(keypair(tmp_path / "operator")).read_text().strip()])
    port = free_tcp_port()
    leaf = NatsServerProcess(tmp_path / "leaf", "leaf", "north", {"http": f"127.0.0.1:{port}"})
    accepting = leaf.config.read_text()
    refusing = json.dumps({**json.loads(accepting), "authorization": {"user": "a", "password": "b"}})
    command = [sys.executable, "-m", "meshctl", "worker", "mines/north", "--nats", leaf.url]
    with subprocess.Popen(command, env=environ, stderr=subprocess.PIPE, text=True) as worker:

        def is_ended() -> bool:
            until(lambda: _connections(port) == 1, "the worker's connection")
            leaf.reload(refusing)
            with suppress(subprocess.TimeoutExpired):
                return worker.wait(5) is not None
            # what it was sending at that moment broke the connection before the reason was read: it makes another one,
            # as after a restart of the server
            leaf.reload(accepting)
            return False

        try:
            assert worker.stderr is not None
            assert "serving mines/north\n" in iter(worker.stderr.readline, "")
            until(is_ended, "the worker's end")
            assert worker.returncode == ExitCode.UNREACHABLE
            assert "error: the leaf node closed the connection: nats: authorization failed" in worker.stderr.read()
        finally:
            worker.kill()
            leaf.stop()


def test_a_worker_that_cannot_connect_yet_says_why(tmp_path: Path) -> None:
    """Its unit starts with the gateway, often before the leaf node, or with a wrong address."""
    environ = {**os.environ, "XDG_STATE_HOME": str(tmp_path)}
    site = SiteDirectory.of("mines/north", environ)
    site.install([public(keypair(tmp_path / "operator")).read_text().strip()])
    leaf = NatsServerProcess(tmp_path / "leaf", "leaf", "north", {})
    leaf.stop()
    command = [sys.executable, "-m", "meshctl", "worker", "mines/north", "--nats", leaf.url]
    with subprocess.Popen(command, env=environ, stderr=subprocess.PIPE, text=True) as worker:
        assert worker.stderr is not None
        try:
            lines = [worker.stderr.readline()]
            leaf.start()
            lines += islice(worker.stderr, 2)
        finally:
            worker.kill()
            leaf.stop()
    assert lines[0].startswith(f"waiting for the leaf node {leaf.url}: ")
    assert lines[1:] == ["connected to the leaf node\n", "serving mines/north\n"]


def _connections(port: int) -> int:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/connz", timeout=10) as answer:
        return int(json.load(answer)["num_connections"])


def test_a_stream_that_may_not_be_made_is_named(hub: NatsServerProcess) -> None:
    with closing(NatsClient(NatsServer(hub.url))) as client:
        with pytest.raises(NatsLost, match=r'permissions violation for publish to "\$js\.api\.stream\.create'):
            client.ensure_stream(name=_NORTH.order_stream, subjects=[_NORTH.orders], **stream_settings(1, 1 << 20))
        # what was refused earlier is not the reason for something else, nor what another site was refused
        client.refusals.check(client.refusals.count)
        client.refusals.check(0, _NORTH.ask)


def test_a_server_that_cannot_write_a_stream_needs_room_and_no_other_address(tmp_path: Path) -> None:
    server = NatsServerProcess(tmp_path, "hub", "hub", {})
    try:
        # like a full disk, which refuses the directory of a stream
        (server.store / "jetstream" / "$G").mkdir(parents=True, exist_ok=True)
        (server.store / "jetstream" / "$G" / "streams").write_text("")
        with (
            closing(NatsClient(NatsServer(server.url))) as client,
            pytest.raises(NatsLost, match="has no room") as lost,
        ):
            client.ensure_stream(name=_NORTH.order_stream, subjects=[_NORTH.orders], **stream_settings(1, 1 << 20))
        assert "make room on the disk of the NATS server" in lost.value.hint
    finally:
        server.stop()
