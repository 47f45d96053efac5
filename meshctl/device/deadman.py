"""A change that undoes itself: the Python side of `meshctl-deadman` (scripts/deadman.sh, docs/device-scripts.md).

A `Change` (files to write, remove, or merely keep safe, and what to reload) becomes a bundle (`bundle`, pure), is
uploaded and staged, armed with a nonce, applied by a process of the node's own, and kept by `confirm` over a new
connection. Whatever stops that chain, the node goes back to what it had.
"""

from __future__ import annotations

import gzip
import hashlib
import re
import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from meshctl.archive import TarMember, tar_of
from meshctl.device.connection import Completed, Connection
from meshctl.device.errors import CommandFailed, NodeRefused
from meshctl.device.observation import ChangeStatus
from meshctl.device.parse.deadman import parse_answer, parse_status
from meshctl.device.scripts import script
from meshctl.device.upload import Progress, upload
from meshctl.model import Secret

PROGRAM = "/usr/sbin/meshctl-deadman"
INIT_SCRIPT = "/etc/init.d/meshctl-deadman"
INIT_LINK = "/etc/rc.d/S05meshctl-deadman"
# The bundle waits in RAM: it is copied into flash by `stage`, and a reboot may forget it.
BUNDLE_DIRECTORY = "/tmp/meshctl"
# Unpacking, copying and syncing into a jffs2 that has to erase blocks first can take a minute.
STAGE_TIMEOUT_S = 180.0

_PATH = re.compile(r"(?:/[A-Za-z0-9._+@-]+){2,}")
_LINK_TARGET = re.compile(r"\.\./init\.d/[A-Za-z0-9._+@-]+")
_WORD = re.compile(r"[A-Za-z0-9][A-Za-z0-9@._:+-]*")


@dataclass(frozen=True, slots=True)
class NewFile:
    """A file the change writes: its bytes and its mode."""

    content: bytes = field(repr=False)
    mode: int = 0o644


@dataclass(frozen=True, slots=True)
class Change:
    """What is to change on a node.

    `files` are written, `links` (path below /etc/rc.d -> target) made, `removed` deleted, `covered` only kept and
    restored (what services write themselves when reloaded). `expected` gives the SHA-256 a touched path must have now,
    or None for absent; the node refuses the change when it finds something else.

    `extra` is POSIX sh for what a change does besides files, called as `extra keep|do|undo DIRECTORY`; see `packages`.

    `reload` is POSIX sh. It runs after the change and, if need be, after the way back, so it must bring the services in
    line with whatever files are there and change none itself. Its exit status should tell whether it worked: where it
    fails after a restore, the node reboots.
    """

    change_id: str
    files: Mapping[str, NewFile]
    reload: str
    links: Mapping[str, str] = field(default_factory=dict)
    removed: tuple[str, ...] = ()
    covered: tuple[str, ...] = ()
    expected: Mapping[str, str | None] = field(default_factory=dict)
    extra: str = ""


def packages(tool: str, files: Iterable[str], remove: Iterable[str] = ()) -> str:
    """A change's `extra` that installs package files which are on the node and removes packages first; undone, the node
    has the packages that it had. `tool` is opkg or apk. Raises ValueError for words with blanks or quotes."""
    words = {"TOOL": [tool], "FILES": list(files), "REMOVE": list(remove)}
    if tool not in ("opkg", "apk"):
        raise ValueError(f"expected opkg or apk, found {tool!r}")
    for word in (*words["FILES"], *words["REMOVE"]):
        if shlex.quote(word) != word:
            raise ValueError(f"{word!r}: expected a path or a name without blanks and quotes")
    lines = [f"{name}='{' '.join(given)}'" for name, given in words.items()]
    return "\n".join([*lines, script("packages.sh")])


def bundle(change: Change) -> bytes:
    """The change as one tar.gz: `manifest`, `reload`, `new/...`; the same change gives the same bytes.

    A manifest line is `KIND MODE SHA256 EXPECTED PATH`. Raises ValueError for a path the node would refuse.
    """
    touched = [*change.files, *change.links, *change.removed, *change.covered]
    for path in touched:
        if not _PATH.fullmatch(path) or any(part in {".", ".."} for part in path.split("/")):
            raise ValueError(f"{path!r}: expected an absolute path of at least two parts, letters, digits and ._+@-")
    for path, target in change.links.items():
        if not path.startswith("/etc/rc.d/") or not _LINK_TARGET.fullmatch(target):
            raise ValueError(f"{path!r} -> {target!r}: expected a link from /etc/rc.d to ../init.d")
    if len(set(touched)) != len(touched):
        raise ValueError(f"change {change.change_id}: a path is named twice")
    lines = [
        f"file {new.mode:04o} {hashlib.sha256(new.content).hexdigest()} {_expected(change, path)} {path}"
        for path, new in change.files.items()
    ]
    lines += [f"link - {target} {_expected(change, path)} {path}" for path, target in change.links.items()]
    lines += [f"remove - - {_expected(change, path)} {path}" for path in change.removed]
    lines += [f"cover - - {_expected(change, path)} {path}" for path in change.covered]
    members: list[TarMember] = [
        TarMember("manifest", "".join(f"{line}\n" for line in lines).encode(), 0o600),
        TarMember("reload", (change.reload.rstrip("\n") + "\n").encode(), 0o600),
        *([TarMember("extra", change.extra.encode(), 0o600)] if change.extra else []),
        *(TarMember(f"new{path}", new.content, new.mode) for path, new in sorted(change.files.items())),
        *(TarMember(f"new{path}", link_to=target) for path, target in sorted(change.links.items())),
    ]
    return gzip.compress(tar_of(members), mtime=0)


def _expected(change: Change, path: str) -> str:
    if path not in change.expected:
        return "-"
    return change.expected[path] or "absent"


def install(connection: Connection) -> None:
    """Put the switch and its boot hook on the node, each in one rename; does nothing where they already are."""
    for path, (mode, content) in installed_files().items():
        upload(connection, content, path, mode=mode)
    link = f"../init.d/{INIT_SCRIPT.rsplit('/', 1)[1]}"
    connection.run(f"mkdir -p {INIT_LINK.rsplit('/', 1)[0]} && ln -sfn {link} {INIT_LINK} && /bin/sync").check(
        f"{connection.endpoint.label}: enable the boot hook"
    )


def installed_files() -> dict[str, tuple[int, bytes]]:
    """Path -> (mode, content) of what `install` writes; the boot hook also needs the link INIT_LINK."""
    return {
        PROGRAM: (0o755, script("deadman.sh").encode()),
        INIT_SCRIPT: (0o755, script("deadman.init").encode()),
    }


def status(connection: Connection) -> ChangeStatus:
    """The switch's state; `installed=False` where it is not on the node."""
    done = connection.run(f"[ -x {PROGRAM} ] || {{ echo absent; exit 0; }}; {PROGRAM} status")
    if done.stdout.strip() == "absent":
        return ChangeStatus(state="absent", installed=False)
    found = parse_status(done.stdout)
    if found is None:
        raise _unreadable(connection, "status", done)
    return found


def lock(connection: Connection, owner: str, *, ttl_s: int) -> None:
    """Take or renew the node's lock. Raises NodeRefused (`locked`, with who holds it and for how long)."""
    _verb(connection, "lock", owner, str(ttl_s))


def unlock(connection: Connection, owner: str) -> None:
    """Give the lock back; another owner's lock stays."""
    _verb(connection, "unlock", owner)


def stage(
    connection: Connection,
    owner: str,
    change: Change,
    *,
    rate_bytes_per_s: float | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> None:
    """Upload and stage a change; nothing it touches changes yet, and the previous state is kept in flash.

    Raises NodeRefused with the node's reason: `foreign-changes`, `moved-on`, `flash-full`, `bad-uci`, `locked`, `busy`.
    """
    path = f"{BUNDLE_DIRECTORY}/{change.change_id}.tgz"
    upload(connection, bundle(change), path, mode=0o600, rate_bytes_per_s=rate_bytes_per_s, progress=progress)
    try:
        _verb(connection, "stage", owner, change.change_id, path, timeout_s=STAGE_TIMEOUT_S)
    finally:
        connection.run(f"rm -f {shlex.quote(path)}")


def arm(connection: Connection, owner: str, change_id: str, *, nonce: Secret, window_s: int) -> None:
    """From here on only `confirm` with this nonce keeps the change. The node learns the nonce's hash alone."""
    digest = hashlib.sha256(nonce.reveal().encode()).hexdigest()
    _verb(connection, "arm", owner, change_id, digest, str(window_s))


def apply(
    connection: Connection, owner: str, change_id: str, *, in_s: float | None = None, at_uptime_s: float | None = None
) -> float:
    """Start the change: now, `in_s` seconds from now, or when the node's own uptime reaches `at_uptime_s`.

    Returns the node's uptime in seconds at which it switches. The answer comes at once; the change is made by a process
    of the node's own. Ask `status`, over a new connection, for `applied`.
    """
    if in_s is not None and at_uptime_s is not None:
        raise ValueError("give in_s or at_uptime_s, not both")
    when = ["now"]
    if in_s is not None:
        when = ["in", f"{in_s:.2f}"]
    elif at_uptime_s is not None:
        when = ["at", f"{at_uptime_s:.2f}"]
    return float(_verb(connection, "apply", owner, change_id, *when).get("due_uptime_s", "nan"))


def confirm(connection: Connection, change_id: str, *, nonce: Secret) -> None:
    """Keep the change; safe to repeat when the answer was lost. Raises NodeRefused (`restored`, `wrong-nonce`, ...).

    The connection has to be a new one, opened after the change was applied: that is what proves the node reachable.
    """
    _verb(connection, "confirm", change_id, nonce.reveal())


def abort(connection: Connection, owner: str, change_id: str) -> None:
    """Drop a staged change, or have an applied one taken back now."""
    _verb(connection, "abort", owner, change_id)


def _verb(connection: Connection, verb: str, *words: str, timeout_s: float | None = None) -> dict[str, str]:
    for word in words:
        if not _WORD.fullmatch(word) and not word.startswith("/"):
            raise ValueError(f"{verb}: expected letters, digits and @._:+-, found {word!r}")
    done = connection.run(shlex.join([PROGRAM, verb, *words]), timeout_s=timeout_s)
    answer = parse_answer(done.stdout)
    if answer.ok:
        return answer.values
    if answer.code:
        raise NodeRefused(
            f"{connection.endpoint.label}: {verb}: {answer.text}",
            code=answer.code,
            exit_status=done.exit_status,
            hint=_HINTS.get(answer.code, ""),
        )
    raise _unreadable(connection, verb, done)


# What to do about a refusal whose text does not tell; by its word (docs/device-scripts.md).
_HINTS = {
    "locked": "wait for the other one to end, or for the lock to run out",
    "flash-full": "`meshctl run NODE -- du -ak /overlay` shows what takes the room",
    "moved-on": "somebody changed it meanwhile: plan again",
    "not-locked": "it has run out, or the node rebooted: run again",
    "tmp-full": "`meshctl run NODE -- du -ak /tmp` shows what takes the room; a reboot empties it",
}


def _unreadable(connection: Connection, verb: str, done: Completed) -> CommandFailed:
    said = (done.stderr or done.stdout).strip() or "nothing"
    return CommandFailed(
        f"{connection.endpoint.label}: the dead-man's switch answered {verb} with {said!r}",
        exit_status=done.exit_status,
        stderr=done.stderr,
        hint=f"is {PROGRAM} installed? `meshctl provision` installs it",
    )
