"""The store of logs on disk, by itself."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from udp_mesh.core.logs.item import ItemId, LogKey
from udp_mesh.core.logs.store import LogContents
from udp_mesh.daemon.log_store import FIRST_PLAUSIBLE_S, SqliteLogStore

ITEM = ItemId(LogKey("artifact", "spot", bytes(32)), 1)
NOW_S = FIRST_PLAUSIBLE_S + 1e6


class Store(SqliteLogStore):
    """Its clock is set by hand."""

    def __init__(self, path: Path) -> None:
        self.wall_s = NOW_S
        super().__init__(path, lambda: self.wall_s)


def with_store(path: Path, use: Callable[[Store, LogContents], Awaitable[None]], *, wall_s: float = NOW_S) -> None:
    """Opens the store on an event loop of its own, and closes it."""

    async def run() -> None:
        store = Store(path)
        store.wall_s = wall_s
        contents = store.load()
        try:
            await use(store, contents)
        finally:
            await asyncio.get_running_loop().run_in_executor(None, store.close)

    asyncio.run(run())


def put(store: Store, item: ItemId, data: bytes) -> None:
    store.put(item, data, taken=False, done=lambda _: None)


def test_a_refused_item_is_reported_to_its_publisher_alone(tmp_path: Path) -> None:
    async def use(store: Store, _: LogContents) -> None:
        def refuse(connection: sqlite3.Connection) -> None:
            connection.execute(
                "CREATE TEMP TRIGGER refuse BEFORE INSERT ON items WHEN NEW.number = 2"
                " BEGIN SELECT RAISE(ABORT, 'disk is full'); END"
            )

        store._jobs.put((refuse, lambda: None))
        puts = []
        for number in (1, 2, 3):
            put(store, ItemId(ITEM.log, number), b"data")
            assert store.last_put is not None
            puts.append(store.last_put)
        for one in puts:
            await asyncio.wait_for(one.stored.wait(), 10)
        assert [one.problem for one in puts] == [None, "disk is full", None]

    with_store(tmp_path / "items.db", use)


def test_a_second_daemon_does_not_use_the_same_numbers(tmp_path: Path) -> None:
    async def use(store: Store, contents: LogContents) -> None:
        other = Store(tmp_path / "items.db")
        try:
            assert other.load().seed != contents.seed
            put(other, ITEM, b"data")
            assert other.last_put is not None
            await asyncio.wait_for(other.last_put.stored.wait(), 10)
            assert other.last_put.problem == "database is locked"
        finally:
            other.close()

    with_store(tmp_path / "items.db", use)


@pytest.mark.parametrize(
    ("stored_at_s", "loaded_at_s", "age_s"),
    [
        (NOW_S, NOW_S + 60, 60.0),
        # No battery-backed clock: set between two runs.
        (10.0, NOW_S, 0.0),
        (NOW_S, NOW_S - 60, 0.0),
    ],
)
def test_items_do_not_age_by_a_step_of_the_clock(
    tmp_path: Path, stored_at_s: float, loaded_at_s: float, age_s: float
) -> None:
    async def use(store: Store, _: LogContents) -> None:
        put(store, ITEM, b"data")

    ages: list[float] = []

    async def look(_: Store, contents: LogContents) -> None:
        ages.extend(item.age_s for item in contents.items)

    with_store(tmp_path / "items.db", use, wall_s=stored_at_s)
    with_store(tmp_path / "items.db", look, wall_s=loaded_at_s)
    assert ages == [age_s]


def test_reading_an_unknown_item_writes_nothing(tmp_path: Path) -> None:
    async def use(store: Store, _: LogContents) -> None:
        answers: list[bytes | None] = []
        read = asyncio.Event()
        store.on_done = read.set
        store.get(ITEM, answers.append)
        await asyncio.wait_for(read.wait(), 10)
        assert answers == [None]

    with_store(tmp_path / "items.db", use)
    with sqlite3.connect(tmp_path / "items.db") as connection:
        assert connection.execute("SELECT count(*) FROM logs").fetchone() == (0,)


def test_an_item_whose_log_is_unknown_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "items.db"

    async def write(store: Store, _: LogContents) -> None:
        for number in (1, 2):
            put(store, ItemId(ITEM.log._replace(topic=f"topic{number}"), number), b"data")
        assert store.last_put is not None
        await asyncio.wait_for(store.last_put.stored.wait(), 10)

    async def read(_: Store, contents: LogContents) -> None:
        assert [item.id.number for item in contents.items] == [2]

    with_store(path, write)
    connection = sqlite3.connect(path)
    connection.execute("DELETE FROM logs WHERE topic = 'topic1'")
    connection.commit()
    connection.close()
    with_store(path, read)


def test_a_job_that_fails_in_any_way_does_not_end_the_thread(tmp_path: Path) -> None:
    async def use(store: Store, _: LogContents) -> None:
        def fail(connection: sqlite3.Connection) -> None:
            raise MemoryError("no memory")

        answered = asyncio.Event()
        store._jobs.put((fail, answered.set))
        await asyncio.wait_for(answered.wait(), 10)
        assert store.problem == "no memory"
        put(store, ITEM, b"data")
        assert store.last_put is not None
        await asyncio.wait_for(store.last_put.stored.wait(), 10)
        assert store.last_put.problem is None

    with_store(tmp_path / "items.db", use)


def test_an_exception_in_one_callback_does_not_keep_the_results_of_others(tmp_path: Path) -> None:
    async def use(store: Store, _: LogContents) -> None:
        reported = asyncio.Event()
        answers: list[str] = []
        store.on_done = reported.set

        def fail() -> None:
            raise ValueError("in a callback")

        store._report([fail, lambda: answers.append("second")])
        await asyncio.wait_for(reported.wait(), 10)
        assert answers == ["second"]

    with_store(tmp_path / "items.db", use)
