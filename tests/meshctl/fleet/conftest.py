"""A PostgreSQL server for the tests of a shared journal, where there is one (scripts/setup-postgresql)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.meshctl.fleet.postgresql_server import Server, expects_postgresql, running

collect_ignore = [] if expects_postgresql() else ["test_shared_store.py"]


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    with running() as server:
        yield server
