"""Drops root privileges once the sockets are open (setresuid(2)); for starts without systemd's `User=`."""

from __future__ import annotations

import os
import pwd
from pathlib import Path


def drop_privileges(user: str, owned: tuple[Path, ...]) -> None:
    """Gives the `owned` files and directories to the user and switches to it irrevocably.

    Raises OSError if the user does not exist or this process is not root.
    """
    try:
        entry = pwd.getpwnam(user)
    except KeyError as error:
        raise OSError(f"daemon.user: no such user: {user!r}") from error
    if os.geteuid() == entry.pw_uid:
        return
    for path in owned:
        if not path.is_file():
            path.mkdir(parents=True, exist_ok=True)
        os.chown(path, entry.pw_uid, entry.pw_gid)
    os.initgroups(user, entry.pw_gid)
    os.setresgid(entry.pw_gid, entry.pw_gid, entry.pw_gid)
    os.setresuid(entry.pw_uid, entry.pw_uid, entry.pw_uid)
