"""NATS servers that lose what they stored: a real hub and leaf node, a worker that publishes, no nodes."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import closing
from pathlib import Path

import pytest

from meshctl.errors import MeshctlError
from meshctl.sites.nats_client import NatsClient, NatsServer, stream_settings
from meshctl.sites.nats_worker import NatsWorker
from meshctl.sites.runs import RunDirectory, SiteDirectory, write_json
from meshctl.sites.subjects import SiteSubjects
from tests.meshctl.device.servers import keypair, public
from tests.meshctl.sites.nats_servers import NatsServerProcess, NatsSites
from tests.waiting import until

pytestmark = [pytest.mark.xdist_group("nats"), pytest.mark.timeout(300)]
_SUBJECTS = SiteSubjects("mines", "north")
_STREAM, _LIMITS = _SUBJECTS.run_stream, stream_settings(1, 1 << 20)


@pytest.fixture
def servers(tmp_path: Path) -> Iterator[NatsSites]:
    with NatsSites(tmp_path / "nats", ["north"]) as started:
        yield started


@pytest.fixture
def hub(servers: NatsSites) -> Iterator[NatsClient]:
    with closing(NatsClient(NatsServer(servers.hub.url))) as client:
        yield client


@pytest.fixture
def site(servers: NatsSites, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SiteDirectory]:
    """A site whose worker publishes, in a thread that ends with its connection."""
    monkeypatch.setattr("meshctl.sites.nats_worker._CHECK_S", 0.5)
    directory = SiteDirectory.of("mines/north", {"XDG_STATE_HOME": str(tmp_path)})
    directory.install([public(keypair(tmp_path / "operator")).read_text().strip()])
    client = NatsClient(NatsServer(servers.leaves["north"].url), waits_at_start=True)
    worker = NatsWorker(directory, {}, client, "hub")
    is_over = threading.Event()

    def publish() -> None:
        while not is_over.is_set():
            try:
                worker._events()
            except (MeshctlError, CancelledError):
                is_over.wait(0.2)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield directory
    finally:
        is_over.set()
        client.close()
        thread.join()


def finished_run(site: SiteDirectory, number: int) -> str:
    """A run that is over, with one event."""
    run = RunDirectory(site.root / "runs" / f"{number:016x}")
    run.path.mkdir(parents=True)
    run.events.write_text(json.dumps({"event": "note", "node": "", "at_s": 0.0, "text": f"run {number}"}) + "\n")
    write_json(run.over, {"error": ""})
    write_json(run.order, {"operator": "alice", "command": "provision"})
    return run.path.name


def ends(hub: NatsClient, run: str) -> bool:
    """Whether the hub's copy has how a run ended."""
    hub.ensure_mirror(_STREAM, "north", **_LIMITS)
    return hub.queued(_STREAM, _SUBJECTS.run(run)) > 1


def lose_store(server: NatsServerProcess) -> None:
    server.stop()
    shutil.rmtree(server.store)
    server.start()


def test_what_a_leaf_node_loses_is_published_again_above_what_the_hub_has_copied(
    servers: NatsSites, hub: NatsClient, site: SiteDirectory
) -> None:
    first = [finished_run(site, number) for number in range(1, 6)]
    until(lambda: all(ends(hub, run) for run in first), "five runs at the hub", wait_s=60)
    copied = hub.last_sequence(_STREAM)
    # the sixth ends while the uplink is down, and the leaf node loses it
    servers.uplinks["north"].cut()
    unseen = finished_run(site, 6)
    published = RunDirectory(site.root / "runs" / unseen).published
    until(lambda: published.exists() and "true" in published.read_text(), "its publication", wait_s=60)
    lose_store(servers.leaves["north"])
    servers.uplinks["north"].mend()
    until(lambda: hub.queued(_STREAM, _SUBJECTS.run(unseen)) > 1, "it at the hub", wait_s=120)
    assert hub.last_sequence(_STREAM) > copied


def test_the_copy_of_a_gateway_that_was_replaced_is_made_anew(
    servers: NatsSites, hub: NatsClient, site: SiteDirectory
) -> None:
    """Its worker knows no earlier runs, and the new leaf node numbers from 1."""
    first = [finished_run(site, number) for number in range(1, 6)]
    until(lambda: all(ends(hub, run) for run in first), "five runs at the hub", wait_s=60)
    servers.leaves["north"].stop()
    shutil.rmtree(servers.leaves["north"].store)
    for run in first:
        RunDirectory(site.root / "runs" / run).discard()
    servers.leaves["north"].start()
    later = finished_run(site, 7)
    until(lambda: ends(hub, later), "the run of the new gateway at the hub", wait_s=120)


def test_a_hub_that_loses_its_store_copies_again(servers: NatsSites, hub: NatsClient, site: SiteDirectory) -> None:
    run = finished_run(site, 1)
    until(lambda: ends(hub, run), "the run at the hub", wait_s=60)
    lose_store(servers.hub)
    until(lambda: hub.is_connected, "the connection", wait_s=60)
    until(lambda: ends(hub, run), "the run at the hub again", wait_s=120)
