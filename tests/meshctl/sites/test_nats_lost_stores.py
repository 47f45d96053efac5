"""NATS servers that lose what they stored: a real hub and leaf node, a worker that publishes, no nodes."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Self

import pytest

from meshctl.device.trust import TrustStore
from meshctl.errors import MeshctlError
from meshctl.inventory import load_fleet
from meshctl.model import Fleet
from meshctl.nodes.connections import ConnectionPool
from meshctl.sites.nats_client import NatsClient, NatsServer
from meshctl.sites.nats_uplink import NatsUplink
from meshctl.sites.nats_worker import NatsWorker
from meshctl.sites.runs import RunDirectory, SiteDirectory, write_json
from meshctl.sites.subjects import CONSUMER, SiteSubjects, stream_settings
from meshctl.sites.uplink import SiteOffline
from tests.meshctl.device.servers import keypair, public
from tests.meshctl.sites.nats_servers import NatsServerProcess, NatsSites
from tests.waiting import until

pytestmark = [pytest.mark.xdist_group("nats")]
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


@contextmanager
def serving(directory: Path, url: str, loops: Iterable[str]) -> Iterator[SiteDirectory]:
    """A site whose worker runs these of its loops, in threads that end with its connection."""
    site = SiteDirectory.of("mines/north", {"XDG_STATE_HOME": str(directory)})
    site.install([public(keypair(directory / "operator")).read_text().strip()])
    client = NatsClient(NatsServer(url), note=lambda reason: None)
    worker = NatsWorker(site, {}, client, "hub")
    is_over = threading.Event()

    def repeat(loop: Callable[[], None]) -> None:
        while not is_over.is_set():
            with suppress(MeshctlError, CancelledError):
                loop()
            is_over.wait(0.2)

    threads = [threading.Thread(target=repeat, args=(getattr(worker, name),), daemon=True) for name in loops]
    for thread in threads:
        thread.start()
    try:
        yield site
    finally:
        is_over.set()
        client.close()
        # the others wait for requests
        threads[0].join()


@pytest.fixture
def site(servers: NatsSites, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SiteDirectory]:
    monkeypatch.setattr("meshctl.sites.nats_worker._CHECK_S", 0.5)
    with serving(tmp_path, servers.leaves["north"].url, ["_events"]) as made:
        yield made


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


def test_the_copy_of_a_gateway_that_was_replaced_is_made_again(
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


INVENTORY = """\
meshctl: 1
fleet: mines
country: US
operators: {{ssh_keys: ["{key}"]}}
nats: {{url: {hub}}}
sites: {{north: {{nats: {{}}, ssh: {{key_files: ["{private}"]}}, worker_key: {worker}}}}}
nodes: {{}}
"""


class Orders:
    """A work queue at the hub and what reaches a worker at the leaf node, which runs in a `with` block."""

    def __init__(self, hub: NatsClient, leaf: NatsServerProcess) -> None:
        self._hub, self._worker = hub, NatsClient(NatsServer(leaf.url))
        self._stream = _SUBJECTS.order_stream
        self.reached: list[str] = []

    def give(self, run: str) -> None:
        """Store an order, as `NatsUplink.start` does."""
        orders = [_SUBJECTS.orders]
        self._hub.ensure_stream(name=self._stream, subjects=orders, retention="workqueue", **_LIMITS)
        self._hub.restart_consumer(self._stream, CONSUMER)
        self._hub.store(_SUBJECTS.order(run), run, b"an order")

    def give_and_wait(self, *runs: str) -> None:
        for run in runs:
            self.give(run)
        until(lambda: [_SUBJECTS.order(run) for run in runs] == self.reached[-len(runs) :], "the orders", wait_s=60)
        until(lambda: not self._hub.subjects(self._stream), "the hub to know", wait_s=60)

    def _work(self) -> None:
        with suppress(CancelledError):
            for message in self._worker.work(self._stream, _SUBJECTS.orders, "hub", CONSUMER):
                message.acknowledge()
                self.reached.append(message.subject)

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.close()
        self._thread.join()


@pytest.fixture
def orders(servers: NatsSites, hub: NatsClient, monkeypatch: pytest.MonkeyPatch) -> Iterator[Orders]:
    monkeypatch.setattr("meshctl.sites.nats_client._FETCHES", 1)
    monkeypatch.setattr("meshctl.sites.nats_client.ANSWER_S", 1.0)
    with Orders(hub, servers.leaves["north"]) as made:
        yield made


@pytest.mark.parametrize("lost", ["*", "streams/*/msgs/*"], ids=["everything", "the messages of its streams"])
def test_an_order_after_a_hub_has_lost_its_store_reaches_the_worker(
    lost: str, servers: NatsSites, hub: NatsClient, orders: Orders
) -> None:
    """The worker would wait for the next number of a stream that begins again."""
    orders.give_and_wait("1", "2", "3")
    servers.hub.stop()
    for path in (servers.hub.store / "jetstream" / "$G").glob(lost):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    servers.hub.start()
    until(lambda: hub.is_connected, "the operator's connection", wait_s=60)
    orders.give_and_wait("4")
    assert orders.reached == [_SUBJECTS.order(run) for run in ("1", "2", "3", "4")]


def test_a_worker_whose_consumer_was_deleted_makes_it_again(hub: NatsClient, orders: Orders) -> None:
    """To fetch from a consumer that is gone is silent, like fetching from one without messages."""
    orders.give_and_wait("1")
    hub._run(hub._jetstream("").delete_consumer(_SUBJECTS.order_stream, CONSUMER))
    orders.give_and_wait("2")


def test_a_worker_that_cannot_store_events_is_asked_for_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The leaf node has less room than its stream may use, as with a full disk."""
    monkeypatch.setattr("meshctl.sites.nats_uplink._QUIET_S", 1.0)
    with (
        NatsSites(tmp_path / "nats", ["north"], leaf_store_bytes=1 << 20) as servers,
        serving(tmp_path, servers.leaves["north"].url, ["_events", "_asks", "_beats"]) as site,
    ):
        run = finished_run(site, 1)
        private = tmp_path / "operator"
        key, worker = (path.read_text().strip() for path in (public(private), public(site.key)))
        path = tmp_path / "fleet.yaml"
        path.write_text(INVENTORY.format(key=key, hub=servers.hub.url, private=private, worker=worker))
        fleet = load_fleet(path)
        access = ConnectionPool(fleet, TrustStore(tmp_path / "known_hosts"), use_agent=False)
        uplink = until(lambda: connected(fleet, access), "the worker to answer", wait_s=60)
        with uplink:
            replies = list(uplink.follow(run, 0))
    assert [event["text"] for reply in replies for event in reply.get("events", [])] == ["run 1"]
    assert replies[-1]["over"] == {"error": ""}
    assert all("do not come through the NATS servers" in reply["note"] for reply in replies)


def connected(fleet: Fleet, access: ConnectionPool) -> NatsUplink | None:
    try:
        return NatsUplink(fleet, fleet.sites["north"], access)
    except SiteOffline:
        return None
