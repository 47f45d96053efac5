"""Changes that roll back unless confirmed: client of `meshctl-deadman` (scripts/deadman.sh, docs/device-scripts.md).

A `Change` (files to write, remove or only back up, and the reload) becomes a bundle (`bundle`, pure). It is uploaded
and staged, armed with a nonce, applied by a process on the node, and made permanent by `confirm` over a new connection.
If any step fails, the node rolls back to its previous state.
"""

from __future__ import annotations

import gzip
import hashlib
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from meshctl.archive import TarMember, tar_of
from meshctl.device.connection import Completed, Connection
from meshctl.device.errors import CommandFailed, NodeRefused
from meshctl.device.observation import ChangeStatus
from meshctl.device.parse.deadman import parse_answer, parse_status
from meshctl.device.scripts import script
from meshctl.device.upload import UploadProgress, longest_s, paced, upload
from meshctl.model import Secret
from meshctl.wording import lock_owners

PROGRAM = "/usr/sbin/meshctl-deadman"
INIT_SCRIPT = "/etc/init.d/meshctl-deadman"
INIT_LINK = "/etc/rc.d/S05meshctl-deadman"
# What a sysupgrade that someone else starts carries over, besides /etc/config: with the change in progress and the boot
# hook, the new system returns to the configuration from before an unconfirmed change, as after a power cut.
KEEP_LIST = "/lib/upgrade/keep.d/meshctl"
_KEPT = ("/etc/meshctl", PROGRAM, INIT_SCRIPT, INIT_LINK, KEEP_LIST)
# The bundle is in RAM until `stage` copies it to flash; a reboot may lose it.
BUNDLE_DIRECTORY = "/tmp/meshctl"
# Unpacking, copying and syncing into a jffs2 that has to erase blocks first can take a minute.
STAGE_TIMEOUT_S = 180.0
# Sent with one command; configuration and keys of a node are a tenth of it.
MAX_INLINE_BUNDLE_BYTES = 64 << 10
_NO_ROOM = f"echo 'refused tmp-full no room in {BUNDLE_DIRECTORY} for the bundle'"

_PATH = re.compile(r"(?:/[A-Za-z0-9._+@-]+){2,}")
_LINK_TARGET = re.compile(r"\.\./init\.d/[A-Za-z0-9._+@-]+")
_WORD = re.compile(r"[A-Za-z0-9][A-Za-z0-9@._:+-]*")
# OpenWrt's versions have "~", as in wpad-mesh-mbedtls-2025.08.26~ca266cc2-r1.apk
_PACKAGE = re.compile(r"[\w@%+=:,./~-]+", re.ASCII)


@dataclass(frozen=True, slots=True)
class NewFile:
    """The content and mode of a file that the change writes."""

    content: bytes = field(repr=False)
    mode: int = 0o644


@dataclass(frozen=True, slots=True)
class Change:
    """A change of a node.

    `files` are written, `links` (path below /etc/rc.d -> target) created, `removed` deleted, `covered` only backed up
    and restored (files that services write when reloaded). `expected` is the SHA-256 a touched path must have before
    the change, or None for absent; the node refuses the change if it differs.

    `extra` is POSIX sh for changes other than files, called as `extra keep|do|undo DIRECTORY`; see `packages`.

    `reload` is POSIX sh. It runs after the change and after a rollback, so it must apply whatever files there are and
    change none itself. Its exit status must report success: if it fails after a rollback, the node reboots.
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
    """A change's `extra` that removes packages and installs package files that are on the node; a rollback restores
    the previous packages. `tool` is opkg or apk. Raises ValueError for words with blanks or quotes."""
    words = {"TOOL": [tool], "FILES": list(files), "REMOVE": list(remove)}
    if tool not in ("opkg", "apk"):
        raise ValueError(f"expected opkg or apk, found {tool!r}")
    for word in (*words["FILES"], *words["REMOVE"]):
        if not is_package_word(word):
            raise ValueError(f"{word!r}: expected a path or a name without blanks and quotes")
    lines = [f"{name}='{' '.join(given)}'" for name, given in words.items()]
    return "\n".join([*lines, script("packages.sh")])


def is_package_word(word: str) -> bool:
    """Whether the word is a package's name, or the path of a package file that `packages` accepts."""
    return _PACKAGE.fullmatch(word) is not None and not word.startswith("~")


def bundle(change: Change) -> bytes:
    """The change as one deterministic tar.gz: `manifest`, `reload`, `new/...`.

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
    """Install the switch and its boot hook, each in one rename; does nothing if they are installed."""
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
        KEEP_LIST: (0o644, "".join(f"{path}\n" for path in _KEPT).encode()),
    }


def version() -> str:
    """The version of the switch that `install` installs."""
    found = re.search(r"^VERSION=(\S+)", script("deadman.sh"), re.MULTILINE)
    return found[1] if found else ""


def status(connection: Connection, *, started: str = "", await_reload_s: int = 0) -> ChangeStatus:
    """The switch's state; `installed=False` if the node has none.

    While the change `started` is in progress, the node answers when its reload has ended, or after `await_reload_s`.
    """
    wait = ""
    if started and await_reload_s:
        is_reloading = f"[ -e {BUNDLE_DIRECTORY}/change-{started}/due ] && [ ! -e {BUNDLE_DIRECTORY}/reloaded ]"
        wait = f"i={await_reload_s}; while [ $i -gt 0 ] && {is_reloading}; do sleep 1; i=$((i - 1)); done; "
    done = connection.run(f"[ -x {PROGRAM} ] || {{ echo absent; exit 0; }}; {wait}{PROGRAM} status")
    if done.stdout.strip() == "absent":
        return ChangeStatus(state="absent", installed=False)
    found = parse_status(done.stdout)
    if found is None:
        raise _unreadable(connection, "status", done)
    return found


def lock(connection: Connection, owner: str, *, ttl_s: int) -> None:
    """Acquire or renew the node's lock. Raises NodeRefused (`locked`, with its owner and remaining time)."""
    _verb(connection, "lock", owner, str(ttl_s))


def unlock(connection: Connection, owner: str) -> None:
    """Release the lock; another owner's lock stays."""
    _verb(connection, "unlock", owner)


def stage(
    connection: Connection,
    owner: str,
    change: Change,
    *,
    rate_bytes_per_s: float | None = None,
    progress: Callable[[UploadProgress], None] | None = None,
) -> None:
    """Upload and stage a change: no file changes yet, and the previous state is saved in flash.

    Raises NodeRefused with the node's reason: `foreign-changes`, `moved-on`, `flash-full`, `tmp-full`, `bad-uci`,
    `locked`, `busy`.
    """
    content = bundle(change)
    path = f"{BUNDLE_DIRECTORY}/{change.change_id}.tgz"
    words = (owner, change.change_id, path)
    # by the same command: it also goes if this process is killed, or the link is cut, while it is sent or staged
    then = f"rm -f {shlex.quote(path)}"
    if len(content) > MAX_INLINE_BUNDLE_BYTES:
        upload(connection, content, path, mode=0o600, rate_bytes_per_s=rate_bytes_per_s, progress=progress)
        _verb(connection, "stage", *words, timeout_s=STAGE_TIMEOUT_S, then=then)
        return
    _verb(
        connection,
        "stage",
        *words,
        stdin=content if rate_bytes_per_s is None else paced(content, rate_bytes_per_s),
        timeout_s=STAGE_TIMEOUT_S + longest_s(content, rate_bytes_per_s),
        # `stage` refuses what a broken connection has cut short
        first=f"mkdir -p -m 700 {BUNDLE_DIRECTORY}; cat 2>/dev/null >{path} || {{ {_NO_ROOM}; {then}; exit 3; }}",
        then=then,
    )
    if progress is not None:
        progress(UploadProgress(len(content), len(content)))


def arm(connection: Connection, owner: str, change_id: str, *, nonce: Secret, window_s: int) -> None:
    """Arm the change: from now on only `confirm` with this nonce keeps it. The node gets only the nonce's hash."""
    digest = hashlib.sha256(nonce.reveal().encode()).hexdigest()
    _verb(connection, "arm", owner, change_id, digest, str(window_s))


def apply(
    connection: Connection, owner: str, change_id: str, *, in_s: float | None = None, at_uptime_s: float | None = None
) -> float:
    """Start the change: now, `in_s` seconds from now, or when the node's own uptime reaches `at_uptime_s`.

    Returns at once, with the node's uptime in seconds at which the change starts; a process on the node applies it.
    `status`, over a new connection, reports `applied`.
    """
    if in_s is not None and at_uptime_s is not None:
        raise ValueError("give in_s or at_uptime_s, not both")
    when = ["now"]
    if in_s is not None:
        when = ["in", f"{in_s:.2f}"]
    elif at_uptime_s is not None:
        when = ["at", f"{at_uptime_s:.2f}"]
    return float(_verb(connection, "apply", owner, change_id, *when).get("due_uptime_s", "nan"))


@dataclass(frozen=True, slots=True)
class Payload:
    """A change as it is sent: its bundle, built once."""

    change_id: str
    content: bytes = field(repr=False)

    @classmethod
    def of(cls, change: Change) -> Payload:
        return cls(change.change_id, bundle(change))

    @property
    def fits_one_command(self) -> bool:
        """Whether it is sent at once; a larger one is uploaded in pieces, so that a cut link loses only one."""
        return len(self.content) <= MAX_INLINE_BUNDLE_BYTES


def change(
    connection: Connection,
    owner: str,
    payload: Payload,
    *,
    nonce: Secret,
    window_s: int,
    ttl_s: int,
    await_reload_s: int,
    sent: Callable[[], None] = lambda: None,
) -> int | None:
    """Lock, stage, arm and start a change with one command; returns the exit status of its reload, or None if that had
    not ended after `await_reload_s`.

    `sent` is called when the bundle has been sent: from then on the channel is only waited for. A connection that
    breaks leaves nothing changed, or the change as `apply` does. Raises what `stage` and `arm` raise.
    """
    digest = hashlib.sha256(nonce.reveal().encode()).hexdigest()
    words = [owner, str(ttl_s), payload.change_id, digest, str(window_s), str(await_reload_s)]
    words.append(hashlib.sha256(payload.content).hexdigest())

    def pieces() -> Iterator[bytes]:
        yield payload.content
        sent()

    answer = _verb(connection, "change", *words, stdin=pieces(), timeout_s=STAGE_TIMEOUT_S + await_reload_s)
    return int(answer["reload_status"]) if answer.get("reload_status") else None


def confirm(connection: Connection, change_id: str, *, nonce: Secret, owner: str = "") -> None:
    """Make the change permanent; safe to repeat if the answer was lost. Raises NodeRefused (`restored`, ...). With
    `owner`, also release its lock.

    The connection must be opened after the change was applied: that proves the node reachable.
    """
    _verb(connection, "confirm", change_id, nonce.reveal(), *([owner] if owner else []))


def abort(connection: Connection, owner: str, change_id: str) -> None:
    """Drop a staged change, or roll an applied one back now."""
    _verb(connection, "abort", owner, change_id)


def _verb(
    connection: Connection,
    verb: str,
    *words: str,
    stdin: bytes | Iterable[bytes] = b"",
    timeout_s: float | None = None,
    first: str = "",
    then: str = "",
) -> dict[str, str]:
    """Run `first`, the verb, and `then` whatever it says."""
    for word in words:
        if not _WORD.fullmatch(word) and not word.startswith("/"):
            raise ValueError(f"{verb}: expected letters, digits and @._:+-, found {word!r}")
    command = shlex.join([PROGRAM, verb, *words]) + (f"; s=$?; {then}; exit $s" if then else "")
    command = f"{first}\n{command}" if first else command
    done = connection.run(command, stdin=stdin, timeout_s=timeout_s)
    answer = parse_answer(done.stdout)
    if answer.ok:
        return answer.values
    if answer.code:
        raise NodeRefused(
            f"{connection.endpoint.label}: {verb}: {lock_owners(answer.text)}",
            code=answer.code,
            exit_status=done.exit_status,
            hint=HINTS.get(answer.code, ""),
        )
    raise _unreadable(connection, verb, done)


# Hints by refusal code, where the text has none (docs/device-scripts.md).
HINTS = {
    "locked": "wait until the other run ends or its lock expires",
    "flash-full": "`meshctl run NODE -- du -ak /overlay` shows what uses the space",
    "moved-on": "the node has changed since it was planned: plan again",
    "not-locked": "the lock expired, or the node rebooted: run again",
    "tmp-full": "`meshctl run NODE -- du -ak /tmp` shows what uses the space; a reboot empties it",
}


def _unreadable(connection: Connection, verb: str, done: Completed) -> CommandFailed:
    answer = (done.stderr or done.stdout).strip() or "nothing"
    return CommandFailed(
        f"{connection.endpoint.label}: the dead-man's switch answered {verb} with {answer!r}",
        exit_status=done.exit_status,
        stderr=done.stderr,
        hint=f"is {PROGRAM} installed? `meshctl provision` installs it",
    )
