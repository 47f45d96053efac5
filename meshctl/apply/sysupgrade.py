"""Flash one node's firmware: check everything that can fail before any service stops, then prove the result.

`flash`: check the node's memory, upload, `sysupgrade -T`, print the recovery recipe,
start `sysupgrade -n -f` detached. The archive for the new system (`archive`, pure) holds the rendered configuration,
the node's host keys, the dead-man's switch and a marker. Success means the desired revision, the board and the marker,
which only a boot after the flash unpacks.
"""

from __future__ import annotations

import gzip
import secrets
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from meshctl.apply.change_in_progress import LOCK_SLACK_S, install_switch
from meshctl.apply.change_listener import ChangeListener
from meshctl.apply.context import NodeContext
from meshctl.archive import TarMember, tar_of
from meshctl.device import deadman, openwrt
from meshctl.device.observation import Observation
from meshctl.device.observe import observe
from meshctl.device.openwrt import FetchedFile
from meshctl.device.ssh import SshConnection
from meshctl.device.upload import upload
from meshctl.errors import NodeError, Unreachable
from meshctl.firmware import is_revision
from meshctl.fleet import Outcome, Result
from meshctl.model import HardwareProfile
from meshctl.nodes.backoff import Backoff
from meshctl.plan import DesiredState
from meshctl.plan.radios import EVERY_RADIO

IMAGE_PATH = "/tmp/meshctl/firmware.bin"
ARCHIVE_PATH = "/tmp/meshctl/firmware.tgz"
MARKER_PATH = "/etc/meshctl/flashed"
HOST_KEYS = "/etc/dropbear/dropbear_*_host_key"
# For sysupgrade's copy of busybox and what it runs in RAM; with less, the kernel kills it half way.
HEADROOM_BYTES = 4 << 20
# If sysupgrade does not run by then, it was not started, or the node has booted without it.
START_TIMEOUT_S = 120.0
STILL_UPGRADING = "its sysupgrade has not ended"


def flash(ctx: NodeContext, connection: SshConnection, image: Path) -> Outcome:
    """Flash a node and prove it. Owns `connection`. Raises NodeError only while nothing is stopped on the node."""
    listener = ctx.run.new_listener(ctx, EVERY_RADIO)
    try:
        marker = _upload(ctx, connection, image)
        listener.armed(None, for_s=_longest_s(ctx.node.hardware))
        listener.started()
        # if the answer is lost, the node itself shows whether it runs
        with suppress(Unreachable):
            openwrt.start_sysupgrade(connection, IMAGE_PATH, ARCHIVE_PATH)
    except NodeError:
        with suppress(NodeError):
            deadman.unlock(connection, ctx.run.owner)
        raise
    finally:
        connection.close()
    with ctx.step("flash"):
        return _await_return(ctx, marker, listener)


def _upload(ctx: NodeContext, connection: SshConnection, image: Path) -> str:
    """All steps before the start of sysupgrade; returns the marker that the new system will have."""
    size = image.stat().st_size
    with ctx.step("check"):
        _check_memory(ctx.before, size)
        # for its lock: a factory device has none
        install_switch(ctx, connection)
        deadman.lock(connection, ctx.run.owner, ttl_s=_longest_s(ctx.node.hardware) + LOCK_SLACK_S)
    with ctx.step("upload"):
        upload(
            connection, image, IMAGE_PATH, rate_bytes_per_s=ctx.run.rate_bytes_per_s, progress=ctx.progress, mode=0o600
        )
    with ctx.step("test"):
        tested = openwrt.check_firmware(connection, IMAGE_PATH)
        if not tested.valid:
            _free_memory(connection)
            raise NodeError(f"{ctx.name}: its sysupgrade rejects the image: {tested.reason}")
        if tested.available_bytes is not None and tested.available_bytes < HEADROOM_BYTES:
            _free_memory(connection)
            raise NodeError(
                f"{ctx.name}: {tested.available_bytes >> 20} MiB of memory left beside the image, "
                f"{HEADROOM_BYTES >> 20} needed",
                hint="stop services on it, or flash it by cable",
            )
        keys = openwrt.fetch_files(connection, [HOST_KEYS])
        if not keys:
            raise NodeError(f"{ctx.name}: cannot read its host keys, so they would be lost")
        marker = secrets.token_hex(16)
        upload(connection, archive(ctx.desired, keys, marker), ARCHIVE_PATH, mode=0o600)
    recipe = ctx.node.hardware.recovery or "its hardware profile has no recovery instructions"
    ctx.run.note(f"if it does not come back: {recipe}", ctx.name)
    return marker


def _free_memory(connection: SshConnection) -> None:
    """Remove an image that will not be flashed: it takes a tenth of a small board's memory until it reboots."""
    with suppress(NodeError):
        connection.run(f"rm -f {IMAGE_PATH}")


def _check_memory(before: Observation, size: int) -> None:
    needed = size + HEADROOM_BYTES
    if before.memory is not None and before.memory.available < needed:
        raise NodeError(
            f"the image needs {needed >> 20} MiB of memory, {before.memory.available >> 20} are available",
            hint="stop services on it, or flash it by cable",
        )


def archive(desired: DesiredState, host_keys: Mapping[str, FetchedFile], marker: str) -> bytes:
    """The tar.gz that the new system unpacks at its first boot, deterministic."""
    files = [(f"/{file.path}", file.content, file.mode) for file in desired.files]
    files += [(path, file.content, file.mode) for path, file in host_keys.items()]
    files += [(path, content, mode) for path, (mode, content) in deadman.installed_files().items()]
    files.append((MARKER_PATH, f"{marker}\n".encode(), 0o644))
    link = f"../init.d/{deadman.INIT_SCRIPT.rpartition('/')[2]}"
    members = [TarMember(path.lstrip("/"), content, mode) for path, content, mode in sorted(files)]
    members.append(TarMember(deadman.INIT_LINK.lstrip("/"), link_to=link))
    return gzip.compress(tar_of(members), mtime=0)


def _longest_s(hardware: HardwareProfile) -> int:
    """How long a flash may take: before the previous firmware is left, and after that."""
    return 2 * hardware.flash_timeout_s


def _await_return(ctx: NodeContext, marker: str, listener: ChangeListener) -> Outcome:
    """Poll the node until it is back and verified, or the timeout, which counts from its last answer with the previous
    firmware: on a slow processor minutes pass before the flash is written."""
    hardware = ctx.node.hardware
    since_start = Backoff(hardware.flash_timeout_s, ctx.run.interrupt)
    backoff = since_start
    last_error = ""
    while not backoff.is_over and not ctx.run.interrupt.leaving:
        try:
            connection = ctx.run.connections.open(ctx.node)
            try:
                observation = observe(connection, extra_paths=[MARKER_PATH])
                upgrade = None if has_booted(ctx.before, observation, marker) else openwrt.upgrade_state(connection)
            finally:
                connection.close()
        except NodeError as error:
            last_error = str(error)
            # nothing drops logins silently while it is written or boots, and then all of its radios have restarted
            listener.unreachable(is_login_due=True)
        else:
            ctx.run.record(ctx.name, observation)
            if upgrade is None:
                listener.ended(observation, rebooted=True)
                return verdict(ctx.name, ctx.node.hardware, observation, marker)
            if (why := why_not_flashed(*upgrade, after_s=since_start.elapsed_s)) is not None:
                return Outcome(ctx.name, Result.FAILED, f"{why}; it runs the previous firmware")
            last_error = STILL_UPGRADING
            if not since_start.is_over:
                backoff = Backoff(hardware.flash_timeout_s, ctx.run.interrupt)
        backoff.pause()
    return not_back(ctx.name, hardware, last_error, interrupted=ctx.run.interrupt.leaving)


def not_back(name: str, hardware: HardwareProfile, last_error: str, *, interrupted: bool) -> Outcome:
    """The outcome of a node that has not come back in time: its flash may still be written."""
    limit = f"within flash_timeout_s, {hardware.flash_timeout_s} s"
    if interrupted:
        reason = f"interrupted while it was being flashed ({last_error or 'not looked at yet'})"
    elif last_error == STILL_UPGRADING:
        reason = f"{last_error} {limit}"
    else:
        reason = f"not back {limit} after it was last seen with its previous firmware ({last_error})"
    hint = "leave it on: a slow flash may still be written; `meshctl resume` checks it again"
    recovery = f"; if it stays away: {hardware.recovery}" if hardware.recovery else ""
    return Outcome(name, Result.UNCERTAIN, reason, hint=f"{hint}{recovery}")


def why_not_flashed(upgrade: openwrt.Upgrade, output: str, *, after_s: float) -> str | None:
    """Why a node that has not booted since sysupgrade began will not be flashed. None: it may yet be, however long that
    takes on a slow processor."""
    if upgrade is openwrt.Upgrade.ENDED:
        return f"its sysupgrade has failed{f': {output}' if output else ''}"
    if upgrade is openwrt.Upgrade.NOT_STARTED and after_s > START_TIMEOUT_S:
        return "no sysupgrade runs on it"
    return None


def has_booted(before: Observation, observation: Observation, marker: str) -> bool:
    """Whether the node has booted since sysupgrade began. Its marker proves that by itself: nothing but a boot unpacks
    the archive. Otherwise another boot id does, if both are known: a node that is going down may not report its own."""
    if _has_marker(observation, marker):
        return True
    return None not in (before.boot_id, observation.boot_id) and observation.boot_id != before.boot_id


def verdict(name: str, hardware: HardwareProfile, observation: Observation, marker: str) -> Outcome:
    """The outcome of a node that came back: revision, board and marker must match. Neither a boot nor the marker alone
    counts: a board with two slots may unpack the archive and fall back to the previous firmware."""
    running = observation.release.revision if observation.release else "unknown"
    board = observation.board.board_name if observation.board else "unknown"
    desired = hardware.firmware.revision
    problems = [
        "" if is_revision(running, desired) else f"it runs {running}, not {desired}",
        "" if board == hardware.board else f"its board is {board}, not {hardware.board}",
        "" if _has_marker(observation, marker) else "its configuration is not the flashed one",
    ]
    problem_text = "; ".join(problem for problem in problems if problem)
    if problem_text:
        return Outcome(name, Result.FAILED, f"it came back, but {problem_text}")
    return Outcome(name, Result.DONE, facts={"revision": running, "boot_id": observation.boot_id or ""})


def _has_marker(observation: Observation, marker: str) -> bool:
    info = observation.files.get(MARKER_PATH)
    return info is not None and (info.text or "").strip() == marker
