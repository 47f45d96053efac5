"""Install missing packages from local files (nodes have no internet), under the dead-man's switch.

The files are uploaded into the node's memory. A process on the node removes conflicting packages and installs the new
ones; the change is confirmed over a new connection once nothing is missing and the node hears its neighbors again.
Otherwise the node rolls back to its previous packages. Files are applied afterwards, as a change of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from meshctl.apply.change_in_progress import ChangeInProgress
from meshctl.apply.change_set import new_change_id, new_nonce
from meshctl.apply.commit_confirm import run_change
from meshctl.apply.context import NodeContext
from meshctl.apply.first_boot import await_first_boot
from meshctl.apply.health_checks import Expectation
from meshctl.device import deadman
from meshctl.device.deadman import Change
from meshctl.device.framing import quoted
from meshctl.device.observation import Observation, Space
from meshctl.device.ssh import SshConnection
from meshctl.device.upload import upload
from meshctl.errors import InputError, NodeError
from meshctl.fleet import Outcome, Result
from meshctl.inventory.file_paths import file_path
from meshctl.plan import PackageStep
from meshctl.plan.observed_files import CONFIG
from meshctl.plan.radios import EVERY_RADIO, NO_RADIOS

DIRECTORY = "/tmp/meshctl/packages"
# Unpacking packages into jffs2 takes a minute on the slowest boards, and saving the removed ones as long again.
INSTALL_TIMEOUT_S = 300.0
# The conflicting package is the radios' supplicant: netifd sets each radio up with the new one.
_RESTART_RADIOS = "[ ! -x /sbin/wifi ] || /sbin/wifi\n"
# A package's uci-defaults edit /etc/config and commit it (base-files, default_postinst), which needs a reload.
_RELOAD = "reload_config\n"
FLASH_HINT = deadman.HINTS["flash-full"]


def install(ctx: NodeContext, connection: SshConnection, step: PackageStep) -> Outcome:
    """Install the step's packages. Owns `connection`; a confirmed node's connection goes to the pool.

    Raises NodeError when only the node's memory has changed, InputError for a missing file.
    """
    try:
        files = [_local(ctx, file) for file in step.files]
        tool = ctx.before.package_tool
        if tool is None:
            raise NodeError(f"{ctx.name}: expected opkg or apk, found no package manager")
        with ctx.step("packages"):
            # first, because files in memory do not survive the end of a first boot
            await_first_boot(ctx, connection)
            script = deadman.packages(tool, _upload(ctx, connection, files), step.remove)
    except BaseException:
        connection.close()
        raise
    change = _new_change(ctx, connection, script, has_other_supplicant=bool(step.remove))
    # a node that lost its power before the change was armed has lost the files, too
    change.upload_again = partial(_upload, ctx, files=files)
    outcome = run_change(change, connection)
    return with_full_flash(outcome, ctx.before.overlay, sum(file.stat().st_size for file in files))


def with_full_flash(outcome: Outcome, flash: Space | None, needed_bytes: int) -> Outcome:
    """The outcome of an installation, with both sizes if the package files, compressed as flash is, had not fitted into
    the free flash: a package tool does not always name that reason, and the node's refusal gives no size."""
    if outcome.result not in (Result.REFUSED, Result.ROLLED_BACK) or flash is None or flash.free >= needed_bytes:
        return outcome
    free, needed = flash.free >> 10, -(-needed_bytes >> 10)
    why = f"{outcome.reason} ({free} KiB of flash were free; the package files have {needed} KiB)"
    return replace(outcome, reason=why, hint=outcome.hint or FLASH_HINT)


def _upload(ctx: NodeContext, connection: SshConnection, files: Sequence[Path]) -> list[str]:
    paths = []
    # files of an earlier attempt would only fill the memory
    names = "|".join(f"{quoted(file.name)}|.{quoted(file.name)}.*.part" for file in files)
    connection.run(
        f"for f in {DIRECTORY}/* {DIRECTORY}/.*; do case ${{f##*/}} in {names}) ;; *) rm -f $f ;; esac; done"
    )
    for file in files:
        path = f"{DIRECTORY}/{file.name}"
        upload(connection, file, path, rate_bytes_per_s=ctx.run.rate_bytes_per_s, progress=ctx.progress)
        paths.append(path)
    return paths


def _new_change(
    ctx: NodeContext, connection: SshConnection, script: str, *, has_other_supplicant: bool
) -> ChangeInProgress:
    """A change of packages alone: the node keeps its address, and must hear its neighbors again."""
    endpoint = replace(connection.endpoint, identity=ctx.name)
    expected = Expectation(neighbors=ctx.expected.neighbors, base_macs=ctx.expected.base_macs, needs=ctx.desired.needs)
    reload = _RELOAD + (_RESTART_RADIOS if has_other_supplicant else "exit 0\n")
    return ChangeInProgress(
        replace(ctx, expected=expected),
        Change(new_change_id(), {}, reload, extra=script, covered=_configuration(ctx.before)),
        new_nonce(),
        ctx.node.confirm_window_s,
        endpoint,
        (endpoint,),
        extra_s=INSTALL_TIMEOUT_S,
        radios=EVERY_RADIO if has_other_supplicant else NO_RADIOS,
    )


def _configuration(before: Observation) -> tuple[str, ...]:
    """The files below /etc/config, which a package's scripts may change."""
    return tuple(f"/{CONFIG}{package}" for package in sorted(before.uci or {}))


def _local(ctx: NodeContext, file: str) -> Path:
    """A package file's local path; a relative one is relative to the inventory."""
    path = file_path(ctx.run.fleet, file)
    if not path.is_file():
        raise InputError(f"{path}: package file not found", hint="correct package_files in the hardware profile")
    return path
