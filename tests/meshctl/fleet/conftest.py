"""A PostgreSQL server for the tests of a shared journal, where there is one (scripts/setup-postgresql); who uses it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from meshctl.fleet import shared_store
from tests.meshctl.fleet.laptops import Laptop
from tests.meshctl.fleet.postgresql_server import Server, Uplink, expects_postgresql, running

collect_ignore = [] if expects_postgresql() else ["test_shared_store.py", "test_history_follow.py"]


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    with running() as server:
        yield server


@pytest.fixture
def url(server: Server) -> str:
    return server.new_database()


@pytest.fixture
def alice(tmp_path: Path, url: str) -> Laptop:
    return Laptop(tmp_path / "alice", url)


@pytest.fixture
def bob(tmp_path: Path, url: str) -> Laptop:
    return Laptop(tmp_path / "bob", url)


@pytest.fixture
def uplink(server: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[Uplink]:
    monkeypatch.setattr(shared_store, "RETRY_S", 0.05)
    uplink = Uplink(server.port)
    yield uplink
    uplink.close()


@pytest.fixture
def carol(tmp_path: Path, url: str, uplink: Uplink) -> Laptop:
    """Her way to the database can be cut."""
    name = url.rpartition("/")[2]
    return Laptop(tmp_path / "carol", f"postgresql://postgres@127.0.0.1:{uplink.port}/{name}")
