"""Choose this computer's journal: its own file, or the database that `MESHCTL_STORE` names.

`open_journal` opens the database and merges what was kept here meanwhile; if it cannot be reached, the file is used and
its runs are merged later. `notify` receives what the operator has to know about that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from pathlib import Path

from meshctl.errors import MeshctlError
from meshctl.fleet.journal import Journal, default_path
from meshctl.fleet.tolerant_store import TolerantStore

STORE_VARIABLE = "MESHCTL_STORE"


def open_journal(
    environ: Mapping[str, str],
    notify: Callable[[str], None],
    *,
    lab: str = "",
    pinned: Callable[[str], Iterable[str]] = lambda node: (),
    changes_nothing: bool = False,
    of_this_computer: bool = False,
    for_display: bool = False,
) -> Journal:
    """The journal of real fleets as `environ` says; that of a virtual fleet, or with `of_this_computer`, is always the
    file of this computer.

    With `changes_nothing`, a file that cannot be written is a warning; `for_display` is for a command that shows the
    journal, which must not call an unreadable one empty. Raises InputError for a bad URL, MeshctlError for a file or a
    database that cannot be used.
    """
    path, url = default_path(environ), environ.get(STORE_VARIABLE, "")

    def own_file() -> Path | TolerantStore:
        return TolerantStore.open(path, notify, for_display=for_display) if changes_nothing else path

    if not url or lab or of_this_computer:
        return Journal(own_file(), lab=lab, pinned=pinned)
    # psycopg takes a tenth of a second to import
    from meshctl.fleet.postgresql import Database, DatabaseLost, label_of
    from meshctl.fleet.process import owner
    from meshctl.fleet.shared_store import SharedStore, Spool

    try:
        store = SharedStore(Database(url, program=f"meshctl of {owner()}"), path)
    except DatabaseLost as error:
        target = label_of(url)

        notify(f"{error}; the journal of this computer is used, and merged later")
        file = own_file()

        def merge_later(run: int) -> None:
            try:
                with closing(Spool(path)) as spool:
                    spool.note_unmerged(target, run)
            except MeshctlError as unwritable:
                if not isinstance(file, TolerantStore):
                    raise
                file.report(unwritable)

        return Journal(file, pinned=pinned, merge_later=merge_later)
    try:
        merged = store.merge(path)
    except MeshctlError as error:
        notify(f"what this computer recorded while the shared journal was out of reach is not merged yet: {error}")
    except BaseException:
        store.close()
        raise
    else:
        if merged:
            numbers = ", ".join(str(number) for number in merged)
            notify(f"runs of this computer are merged into the shared journal as {numbers}")
    return Journal(TolerantStore(store, notify) if changes_nothing else store, pinned=pinned)
