"""The store of logs on disk, by itself."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import sqlite3
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from udp_mesh.core.logs.item import ItemId, LogKey
from udp_mesh.core.logs.store import ItemUse, LogContents, RememberedLog
from udp_mesh.crypto.signing import SigningKey
from udp_mesh.daemon import log_store
from udp_mesh.daemon.log_rows import FIRST_PLAUSIBLE_S
from udp_mesh.daemon.log_store import SqliteLogStore

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
    store.put(item, data, ItemUse.WAITING, done=lambda _: None)


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
    with contextlib.closing(sqlite3.connect(tmp_path / "items.db")) as connection:
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


KEPT = ItemId(LogKey("artifact", "spot", bytes(range(32))), 7)

DAMAGES = {
    "seed of the wrong length": "UPDATE meta SET value = x'00' WHERE name = 'seed'",
    "seed as text": "UPDATE meta SET value = 'secret' WHERE name = 'seed'",
    "no seed": "DELETE FROM meta",
    "ranges that are no JSON": "UPDATE logs SET dropped = '[[1, 2' WHERE topic = 'damaged'",
    "ranges that overlap": "UPDATE logs SET dropped = '[[1, 5], [3, 9]]' WHERE topic = 'damaged'",
    "ranges of something else": """UPDATE logs SET dropped = '{"1": [true, null]}' WHERE topic = 'damaged'""",
    "deeply nested ranges": f"UPDATE logs SET dropped = '{'[' * 100_000}' WHERE topic = 'damaged'",
    "ranges as a blob": "UPDATE logs SET dropped = x'ff' WHERE topic = 'damaged'",
    "a short log id": "UPDATE logs SET log_id = x'00' WHERE topic = 'damaged'",
    "a source that is no text": "UPDATE logs SET source = 1.5 || x'ff' WHERE topic = 'damaged'",
    "an empty topic": "UPDATE logs SET topic = '' WHERE topic = 'damaged'",
    "a number as text": "UPDATE items SET number = 'one' WHERE number = 1",
    "a negative number": "UPDATE items SET number = -1 WHERE number = 1",
    "data as text": "UPDATE items SET data = 'text' WHERE number = 1",
    "a time as text": "UPDATE items SET stored_s = 'yesterday' WHERE number = 1",
    "an unknown use": "UPDATE items SET taken = 9 WHERE number = 1",
    "carried ranges that are no list": "INSERT INTO carried VALUES (1, '7')",
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_rows_that_make_no_sense_cost_no_other_items(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "items.db"

    async def write(store: Store, _: LogContents) -> None:
        put(store, ItemId(ITEM.log._replace(topic="damaged"), 1), b"data")
        put(store, KEPT, b"data")
        assert store.last_put is not None
        await asyncio.wait_for(store.last_put.stored.wait(), 10)

    async def read(store: Store, contents: LogContents) -> None:
        assert KEPT in [item.id for item in contents.items]
        assert len(contents.seed) == 32
        put(store, ItemId(KEPT.log, 8), b"more")
        assert store.last_put is not None
        await asyncio.wait_for(store.last_put.stored.wait(), 10)
        assert store.last_put.problem is None

    with_store(path, write)
    connection = sqlite3.connect(path)
    connection.execute(damage)
    connection.commit()
    connection.close()
    with_store(path, read)
    assert damage == DAMAGES["no seed"] or "log-row-unusable" in caplog.text
    assert list(tmp_path.glob("*.damaged-*")) == []


@pytest.mark.parametrize(
    ("damage", "renewed"),
    [
        ("UPDATE logs SET dropped = 'none'", True),
        ("UPDATE items SET number = 'nine' WHERE number = 9", True),
        # Its number is known, and counts as used.
        ("UPDATE items SET taken = 9 WHERE number = 9", False),
    ],
)
def test_own_numbers_in_doubt_are_never_used_again(tmp_path: Path, damage: str, renewed: bool) -> None:
    path, seeds = tmp_path / "items.db", list[bytes]()

    async def write(store: Store, contents: LogContents) -> None:
        seeds.append(contents.seed)
        own = LogKey("artifact", "spot", SigningKey(contents.seed).public)
        for number in (8, 9):
            store.put(ItemId(own, number), b"data", ItemUse.TAKEN, lambda _: None)
        store.drop((), (RememberedLog(own, ((1, 7),)),))

    async def read(_: Store, contents: LogContents) -> None:
        assert (contents.seed != seeds[0]) is renewed
        assert [item.id.number for item in contents.items][:1] == [8]
        if not renewed:
            assert [entry.received for entry in contents.remembered] == [((1, 7), (9, 9))]

    with_store(path, write)
    connection = sqlite3.connect(path)
    connection.execute(damage)
    connection.commit()
    connection.close()
    with_store(path, read)


def test_what_is_carried_is_remembered_with_items_and_without_them(tmp_path: Path) -> None:
    path, log = tmp_path / "items.db", ITEM.log

    async def write(store: Store, _: LogContents) -> None:
        for number in (1, 2):
            store.put(ItemId(log, number), b"data", ItemUse.CARRIED, lambda _: None)
        store.drop((ItemId(log, 1),), (RememberedLog(log, ((1, 1),), ((1, 1),)),))

    async def read(store: Store, contents: LogContents) -> None:
        assert [(item.id.number, item.use) for item in contents.items] == [(2, ItemUse.CARRIED)]
        assert contents.remembered == (RememberedLog(log, ((1, 1),), ((1, 1),)),)
        store.mark((ItemId(log, 2),), ItemUse.WAITING)
        store.drop((), (RememberedLog(log, ((2, 2),)),))

    async def read_again(_: Store, contents: LogContents) -> None:
        assert [(item.id.number, item.use) for item in contents.items] == [(2, ItemUse.WAITING)]
        assert contents.remembered == (RememberedLog(log, ((2, 2),)),)

    for use in (write, read, read_again):
        with_store(path, use)


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


async def put_and_wait(store: Store, number: int) -> str | None:
    """Why the item is not on disk, or None."""
    put(store, ItemId(ITEM.log, number), b"data")
    assert store.last_put is not None
    await asyncio.wait_for(store.last_put.stored.wait(), 60)
    return store.last_put.problem


FULL = "disk I/O error"
"""What SQLite makes of EFBIG."""


@contextmanager
def full_disk() -> Iterator[None]:
    """No file of this process can grow."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_hides_no_items_that_are_on_it(tmp_path: Path) -> None:
    path, seeds = tmp_path / "items.db", list[bytes]()

    async def write(store: Store, contents: LogContents) -> None:
        seeds.append(contents.seed)
        assert await put_and_wait(store, 1) is None

    async def use(store: Store, contents: LogContents) -> None:
        assert contents.seed == seeds[0]
        assert [item.id.number for item in contents.items] == [1]
        assert await put_and_wait(store, 2) == FULL
        data: list[bytes | None] = []
        read = asyncio.Event()
        store.on_done = read.set
        store.get(ITEM, data.append)
        await asyncio.wait_for(read.wait(), 60)
        assert data == [b"data"]

    with_store(path, write)
    with full_disk():
        with_store(path, use)


@pytest.mark.parametrize("moves_while_running", [True, False])
def test_a_log_begun_in_memory_moves_to_the_disk_once_there_is_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves_while_running: bool
) -> None:
    monkeypatch.setattr(log_store, "MOVE_AGAIN_S", 0.02 if moves_while_running else 3600.0)
    path, seeds = tmp_path / "logs" / "items.db", list[bytes]()

    async def run() -> None:
        store = Store(path)
        with full_disk():
            seeds.append(store.load().seed)
            assert await put_and_wait(store, 1) == FULL
        if moves_while_running:
            async with asyncio.timeout(60):
                while store.problem is not None:  # noqa: ASYNC110
                    await asyncio.sleep(0.01)
            assert await put_and_wait(store, 2) is None
        else:
            # The last attempt is at the end.
            assert await put_and_wait(store, 2) == FULL
        await asyncio.to_thread(store.close)

    async def look(_: Store, contents: LogContents) -> None:
        assert contents.seed == seeds[0]
        assert [item.id.number for item in contents.items] == [1, 2]

    asyncio.run(run())
    with_store(path, look)


HOLD = """
import sqlite3, sys
held = sqlite3.connect(sys.argv[1], isolation_level=None)
held.execute("BEGIN EXCLUSIVE")
print("locked", flush=True)
sys.stdin.readline()
"""
"""Another process that has locked the database until it is told to end."""


@pytest.mark.parametrize("moves_while_running", [True, False])
def test_a_database_that_was_locked_at_the_start_gets_the_items_once_the_lock_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves_while_running: bool
) -> None:
    monkeypatch.setattr(log_store, "MOVE_AGAIN_S", 0.02 if moves_while_running else 3600.0)
    monkeypatch.setattr(log_store, "LOCK_WAIT_S", 0.02)
    path, seeds = tmp_path / "items.db", list[bytes]()
    shared, only_carried = LogKey("artifact", "husky", bytes(32)), ((5, 6),)

    async def write(store: Store, contents: LogContents) -> None:
        seeds.append(contents.seed)
        assert await put_and_wait(store, 1) is None
        put(store, ItemId(shared, 9), b"before")
        store.drop([], [RememberedLog(shared, ((1, 4), (5, 6)), only_carried)])

    async def run(holder: subprocess.Popen[str]) -> None:
        store = Store(path)
        assert store.load().items == ()
        assert await put_and_wait(store, 2) == "database is locked"
        put(store, ItemId(shared, 8), b"during")
        put(store, ItemId(shared, 9), b"again")
        store.mark([ItemId(shared, 9)], ItemUse.TAKEN)
        store.drop([], [RememberedLog(shared, ((7, 7),))])
        holder.communicate("end\n")
        if moves_while_running:
            async with asyncio.timeout(60):
                while store.problem is not None:  # noqa: ASYNC110
                    await asyncio.sleep(0.01)
            assert await put_and_wait(store, 3) is None
            # The core does not know what the disk remembers.
            store.drop([ItemId(shared, 8)], [RememberedLog(shared, ((7, 8),))])
        await asyncio.to_thread(store.close)

    async def look(_: Store, contents: LogContents) -> None:
        assert contents.seed == seeds[0]
        own = {item.id.number for item in contents.items if item.id.log == ITEM.log}
        assert own == ({1, 2, 3} if moves_while_running else {1, 2})
        others = {item.id.number: item.use for item in contents.items if item.id.log == shared}
        last = {} if moves_while_running else {8: ItemUse.WAITING}
        assert others == {9: ItemUse.TAKEN, **last}
        (remembered,) = contents.remembered
        assert remembered == RememberedLog(shared, ((1, 8 if moves_while_running else 7),), only_carried)

    with_store(path, write)
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        asyncio.run(run(holder))
    with_store(path, look)


def test_items_in_memory_do_not_go_to_a_database_of_a_later_version(tmp_path: Path) -> None:
    path = tmp_path / "items.db"
    with contextlib.closing(sqlite3.connect(path)) as later:
        later.execute("CREATE TABLE items (of_its_own)")
        later.execute("PRAGMA user_version = 9")

    async def use(store: Store, _: LogContents) -> None:
        assert "found 9" in str(await put_and_wait(store, 1))

    with_store(path, use)
    with contextlib.closing(sqlite3.connect(path)) as later:
        assert later.execute("SELECT count(*) FROM items").fetchone() == (0,)


def test_a_second_daemon_keeps_its_items_beside_those_of_the_first_once_that_ends(tmp_path: Path) -> None:
    path, seeds = tmp_path / "items.db", list[bytes]()

    async def use(store: Store, contents: LogContents) -> None:
        seeds.append(contents.seed)
        other = Store(path)
        assert other.load().seed != contents.seed
        assert await put_and_wait(other, 7) == "database is locked"
        store.close()
        other.close()

    async def look(_: Store, contents: LogContents) -> None:
        assert contents.seed == seeds[0]
        assert [item.id.number for item in contents.items] == [7]

    with_store(path, use)
    with_store(path, look)
