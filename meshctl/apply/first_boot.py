"""Wait for the end of the first boot after a flash, in which a node formats its flash and starts its services."""

from __future__ import annotations

from meshctl.apply.context import NodeContext
from meshctl.device.openwrt import is_first_boot
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError
from meshctl.nodes.backoff import Backoff

# Erasing 16 MB of NOR takes up to three minutes, more with other work beside it; then its init scripts run.
FIRST_BOOT_TIMEOUT_S = 600.0


def await_first_boot(ctx: NodeContext, connection: SshConnection) -> None:
    """Wait for the end of the first boot after a flash: a power cut in it undoes confirmed files. Raises NodeError."""
    if not ctx.before.is_first_boot or not is_first_boot(connection):
        return
    ctx.run.note("waiting until its first boot has ended (its flash is formatted, its services start)", ctx.name)
    backoff = Backoff(FIRST_BOOT_TIMEOUT_S, ctx.run.interrupt)
    with ctx.step("first boot"):
        while is_first_boot(connection):
            if ctx.run.interrupt.leaving:
                raise NodeError(f"{ctx.name}: interrupted before its first boot had ended; nothing was changed")
            if backoff.is_over:
                raise NodeError(
                    f"{ctx.name}: its first boot has not ended within {FIRST_BOOT_TIMEOUT_S / 60:.0f} minutes; "
                    "nothing was changed",
                    hint="power-cycle it, then run again; if that does not help, an init script of its image hangs",
                )
            backoff.pause()
