"""Back up a node's state as one archive, and restore it under the dead-man's switch.

`fetch` gets the archive of `sysupgrade -b` (configuration, keys, accounts, the conffiles of packages), checks it
(`read_backup`, pure) and adds the node, board and packages it was taken from. `restore` applies it as any other
change: it rolls back unless the node proves reachable with it.
"""

from __future__ import annotations

import gzip
import io
import json
import re
import tarfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from meshctl.apply.change_in_progress import ChangeInProgress
from meshctl.apply.change_set import new_change_id, new_nonce, reload_script
from meshctl.apply.commit_confirm import run_change
from meshctl.apply.context import NodeContext
from meshctl.apply.health_checks import heard_neighbors
from meshctl.archive import TarMember, tar_of
from meshctl.device import deadman, openwrt
from meshctl.device.connection import OwnKey
from meshctl.device.deadman import Change, NewFile
from meshctl.device.observation import ChangeStatus, Observation
from meshctl.device.ssh import SshConnection
from meshctl.errors import InputError, NodeError
from meshctl.fleet import Outcome, Result
from meshctl.model import Node
from meshctl.model.ip import IpAddress
from meshctl.plan.cell import cells, partitions
from meshctl.plan.lockout import lockout
from meshctl.plan.observed_files import CONFIG, WIRELESS, management_address, packages_seen, parsed
from meshctl.plan.preconditions import FailedPrecondition
from meshctl.plan.radios import NO_RADIOS, Radios, restarting_radios
from meshctl.render import MARKER_PATH

INFO_NAME = "meshctl-backup.json"
# States of the dead-man's switch in which no file has been changed.
_UNTOUCHED = ("absent", "idle", "staged", "armed")
# Far above the size of a router's /etc; bounds a hostile or broken archive.
MAX_FILES, MAX_BYTES = 4000, 64 << 20
# The dead-man's switch accepts absolute paths of at least two parts and plain characters, except its own state.
_PATH = re.compile(r"(/[A-Za-z0-9._+@-]+){2,}")
_OWN = (
    *("/etc/meshctl/change", "/etc/meshctl/last", *deadman.installed_files()),
    *("/tmp/", "/var/", "/dev/", "/proc/", "/sys/"),
)
_REACHABLE_BY = ("network", "wireless", "dropbear", "firewall")
# What a cell is read from.
_CELL_PATHS = (WIRELESS, f"{CONFIG}network")
# From 24.10 on sysupgrade adds a script to every archive that disables, at the next boot, the services that were
# disabled when it was taken (base-files, sbin/sysupgrade). A rollback would not undo that, and the script may name the
# boot hook of the dead-man's switch. So files in this directory are not restored; the services are only reported.
_ONCE_AT_BOOT = "/etc/uci-defaults/"
_DISABLES = re.compile(r"^\s*/etc/init\.d/(\S+) disable\s*$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Backup:
    """A node's files by absolute path, and the node, board and packages they were taken from."""

    node: str
    board: str
    revision: str
    taken_s: float
    packages: tuple[str, ...]
    files: Mapping[str, NewFile] = field(repr=False)
    # services that were disabled at the time
    disabled: tuple[str, ...] = ()


def fetch(connection: SshConnection, node: str, observation: Observation) -> bytes:
    """The node's backup as one tar.gz file. Raises NodeError when it sends something else, or is being changed."""
    info = {
        "node": node,
        "board": observation.board.board_name if observation.board else "",
        "revision": observation.release.revision if observation.release else "",
        "taken_s": round(observation.answered_at_s, 3),
        "packages": sorted(observation.packages or ()),
    }
    archive = openwrt.backup(connection)
    if reason := unconfirmed(node, observation.change, deadman.status(connection)):
        raise NodeError(reason, hint="repeat it when that change has ended")
    try:
        # sysupgrade does not save meshctl's own files; the marker identifies the configuration
        own = openwrt.fetch_files(connection, [f"/{MARKER_PATH}"])
        whole = with_info(archive, info, {path: file.content for path, file in own.items()})
        backup = read_backup(whole, node)
    except InputError as error:
        raise NodeError(f"{node}: expected a backup archive: {error}") from error
    if missing := left_out(backup, observation):
        hint = "add a line `/etc/config/` to /etc/sysupgrade.conf on it: its /lib/upgrade/keep.d lacks one"
        raise NodeError(f"{node}: its `sysupgrade -b` leaves out {', '.join(missing)}: nothing was saved", hint=hint)
    return whole


def left_out(backup: Backup, observation: Observation) -> tuple[str, ...]:
    """The observed UCI files, of those that make a node reachable, that the archive lacks. A restore would leave them
    as they are then, and report success."""
    paths = (f"/{CONFIG}{package}" for package in _REACHABLE_BY if package in (observation.uci or {}))
    return tuple(path for path in paths if path not in backup.files)


def unconfirmed(node: str, before: ChangeStatus | None, after: ChangeStatus) -> str:
    """Why a backup taken between these two states of the dead-man's switch may hold files that were never confirmed;
    empty if it cannot."""
    last_id = "" if before is None else before.last_id
    if (before is None or before.state in _UNTOUCHED) and after.state in _UNTOUCHED and last_id == after.last_id:
        return ""
    owner = after.owner or ("" if before is None else before.owner)
    who = f"{owner} changes it" if owner else "it was changed"
    return f"{node}: {who} while it is backed up, and may roll that back: nothing was saved"


def with_info(archive: bytes, info: Mapping[str, object], extra: Mapping[str, bytes] = MappingProxyType({})) -> bytes:
    """The archive of `sysupgrade -b` with `info` prepended, and further public files by absolute path.

    Raises InputError for a damaged archive.
    """
    added = [TarMember(INFO_NAME, json.dumps(info, indent=1).encode(), 0o600)]
    added += [TarMember(path.lstrip("/"), content) for path, content in extra.items()]
    kept = [(member, content) for member, content in _members(archive, "the archive") if _is_kept(member)]
    return gzip.compress(tar_of(added, copied=kept), mtime=0)


def _is_kept(member: tarfile.TarInfo) -> bool:
    return member.isreg() or member.issym()


def read_backup(data: bytes, file: str) -> Backup:
    """Read an archive that `fetch` made. Raises InputError with the file name and the fault."""
    files: dict[str, NewFile] = {}
    disabled: list[str] = []
    info: dict[str, object] | None = None
    for member, content in _members(data, file):
        if member.name == INFO_NAME:
            info = _info(content, file)
        elif member.isreg():
            path = "/" + member.name.removeprefix("./").lstrip("/")
            if path.startswith(_ONCE_AT_BOOT):
                disabled += _DISABLES.findall(content.decode("utf-8", "replace"))
            elif _PATH.fullmatch(path) and ".." not in path.split("/") and not path.startswith(_OWN):
                files[path] = NewFile(content, member.mode & 0o7777)
    if info is None:
        raise InputError(f"{file}: contains no {INFO_NAME}", hint="expected a file that `meshctl backup` wrote")
    if not any(path.startswith("/etc/config/") for path in files):
        raise InputError(f"{file}: contains no configuration")
    packages = info.get("packages")
    taken = info.get("taken_s")
    return Backup(
        str(info.get("node", "")),
        str(info.get("board", "")),
        str(info.get("revision", "")),
        float(taken) if isinstance(taken, int | float) else 0.0,
        tuple(str(name) for name in packages) if isinstance(packages, list) else (),
        files,
        tuple(disabled),
    )


def _info(content: bytes, file: str) -> dict[str, object]:
    try:
        document = json.loads(content)
    except ValueError as error:
        raise InputError(f"{file}: {INFO_NAME} is damaged: {error}") from error
    if not isinstance(document, dict):
        raise InputError(f"{file}: {INFO_NAME} is damaged: expected an object")
    return document


def _members(data: bytes, file: str) -> list[tuple[tarfile.TarInfo, bytes]]:
    found: list[tuple[tarfile.TarInfo, bytes]] = []
    room = MAX_BYTES
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:gz") as tar:
            for member in tar:
                room -= member.size
                if len(found) >= MAX_FILES or room < 0:
                    raise InputError(f"{file}: contains more than {MAX_FILES} files or {MAX_BYTES >> 20} MiB")
                stream = tar.extractfile(member) if member.isreg() else None
                found.append((member, stream.read() if stream is not None else b""))
    except (tarfile.TarError, OSError, EOFError, zlib.error) as error:
        raise InputError(f"{file}: expected a tar.gz archive: {error}") from error
    return found


def restore_backup(ctx: NodeContext, connection: SshConnection, backup: Backup) -> Outcome:
    """Write the backup's files to the node, under its dead-man's switch. Owns `connection`.

    Raises NodeError only when nothing was changed on the node.

    Files that the backup lacks stay on the node: `sysupgrade -b` does not list what it left out.
    """
    files = files_to_write(backup, ctx.before)
    if not files:
        ctx.run.connections.release(ctx.name, connection)
        return Outcome(ctx.name, Result.UNCHANGED)
    payload = Change(new_change_id(), files, reload_script({path.lstrip("/") for path in files}, ()))
    address = _address(backup)
    change = ChangeInProgress(
        ctx,
        payload,
        new_nonce(),
        ctx.node.confirm_window_s,
        connection.endpoint,
        ctx.run.connections.candidates(ctx.node, address),
        radios=_radios(files, ctx.before),
    )
    return run_change(change, connection)


def files_to_write(backup: Backup, observation: Observation) -> dict[str, NewFile]:
    """The UCI files that differ on the node, and all others."""
    live = observation.uci or {}
    return {path: new for path, new in backup.files.items() if _differs(path, new, live)}


def differing_files(backup: Backup, observation: Observation, connection: SshConnection) -> tuple[str, ...]:
    """The paths that a restore would change on the node, all compared with their current content."""
    files = files_to_write(backup, observation)
    present = openwrt.fetch_files(connection, files)
    return tuple(path for path, new in files.items() if path not in present or present[path].content != new.content)


def _radios(files: Mapping[str, NewFile], before: Observation) -> Radios:
    """The radios that restart with these files."""
    wireless = files.get(f"/{WIRELESS}")
    if wireless is None:
        return NO_RADIOS
    after = parsed(wireless.content.decode("utf-8", "replace"), "wireless")
    return restarting_radios(packages_seen([WIRELESS], before)["wireless"], after)


def _differs(path: str, new: NewFile, live: Mapping[str, str]) -> bool:
    package = path.removeprefix("/etc/config/")
    return package == path or live.get(package) != new.content.decode("utf-8", "replace")


def _address(backup: Backup) -> IpAddress | None:
    """The management address in the backup."""
    network = backup.files.get("/etc/config/network")
    return None if network is None else management_address(network.content.decode("utf-8", "replace"))


def lockout_by(backup: Backup, node: Node, own: Sequence[OwnKey]) -> FailedPrecondition | None:
    """The failed precondition of a backup with which none of our keys could log in, or None."""
    return lockout(node, {path.lstrip("/"): new.content for path, new in backup.files.items()}, own)


def incompatibility(backup: Backup, node: str, observation: Observation) -> str:
    """Why a backup does not fit this device; empty when it fits."""
    board = observation.board.board_name if observation.board else ""
    if backup.board and board != backup.board:
        return f"the backup is of board {backup.board}; the board of {node} is {board or 'unknown'}"
    if backup.node and backup.node != node:
        return f"the backup is of node {backup.node}, not {node}"
    return ""


def without_wireless(backup: Backup) -> Backup:
    """The backup without /etc/config/wireless, so that the node's radios stay as they are."""
    return replace(backup, files={path: new for path, new in backup.files.items() if path != f"/{WIRELESS}"})


def departure(backup: Backup, node: str, observation: Observation) -> str:
    """Why a backup from before a change of the cell would take the node out of the mesh that it is in; empty otherwise.

    A node that hears no mesh neighbor has nothing to leave: it may return to the cell that its mesh still has.
    """
    neighbors = len(heard_neighbors(observation))
    if not neighbors:
        return ""
    before = packages_seen(_CELL_PATHS, observation)
    after = before | {
        name: parsed(new.content.decode("utf-8", "replace"), name)
        for path in _CELL_PATHS
        if (new := backup.files.get(f"/{path}")) is not None and (name := path.removeprefix(CONFIG))
    }
    left = partitions(cells(before["wireless"], before["network"]), cells(after["wireless"], after["network"]))
    if not left:
        return ""
    text = "; ".join(f"{radio}: {', '.join(changes)}" for radio, changes in left.items())
    heard = "the mesh neighbor it hears" if neighbors == 1 else f"the {neighbors} mesh neighbors it hears"
    return f"the backup has another cell ({text}): {node} would leave {heard}"


def uninstalled_packages(backup: Backup, observation: Observation) -> tuple[str, ...]:
    """Packages that were installed when the backup was taken and are not now."""
    return tuple(name for name in backup.packages if name not in (observation.packages or {}))
