"""Find and read the regulatory database: a given file, the system's, or the copy shipped here.

The shipped copy comes from Debian's package wireless-regdb (ISC license, next to it), so that lint works on machines
without it; `scripts/update-regdb` updates it.
"""

from __future__ import annotations

from pathlib import Path

from meshctl.regdb.binary import MAX_BYTES, RegdbError, decode
from meshctl.regdb.values import Regdb

SYSTEM = Path("/lib/firmware/regulatory.db")
SHIPPED = Path(__file__).with_name("regulatory.db")


def shipped_version() -> str:
    """The package and version of the shipped copy."""
    return SHIPPED.with_name("regulatory.db.version").read_text(encoding="utf-8").strip()


def load(path: Path | None = None) -> Regdb:
    """The database at `path`; by default the system's, or else the shipped copy.

    Raises RegdbError with the file and the problem.
    """
    chosen = path or (SYSTEM if SYSTEM.is_file() else SHIPPED)
    try:
        with chosen.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise RegdbError(f"{chosen}: cannot be read: {error.strerror}") from error
    return decode(data, str(chosen))
