"""Pin a host key that the operator has compared: the same steps for nodes, robots' computers and sites' gateways."""

from __future__ import annotations

import sys

import typer

from meshctl.cli.output import echo_lines
from meshctl.device.trust import HostKey, TrustStore


def pin_host_key(
    trust: TrustStore,
    pin_name: str,
    key: HostKey,
    *,
    label: str,
    device: str,
    may_replace: bool,
    yes: bool,
    dry_run: bool = False,
    quiet: bool = False,
) -> bool:
    """Show the key of `label`, ask whether the `device` (node, computer, gateway) has it, and pin it under `pin_name`.

    Returns whether it is pinned in the end, or would be with `dry_run`. `quiet` prints and asks nothing.
    """

    def show(text: str) -> None:
        if not quiet:
            echo_lines(text)

    pinned = trust.pinned(pin_name)
    line = f"{label}: {key.fingerprint} ({key.key_type})"
    if key in pinned:
        show(f"{line}: pinned")
        return True
    if pinned:
        show(f"{line}: DIFFERS from the pinned {', '.join(other.fingerprint for other in pinned)}")
        if not may_replace:
            show("  hint: another device, a new installation, or an attack: verify, then use --replace")
            return False
    else:
        show(f"{line}: not pinned")
    if dry_run:
        show("  would be pinned after confirmation")
        return True
    if not yes and not _confirms(device, quiet=quiet):
        return False
    trust.replace(pin_name, key)
    show(f"{line}: pinned now")
    return True


def _confirms(device: str, *, quiet: bool) -> bool:
    if quiet:
        return False
    if not sys.stdin.isatty():
        echo_lines(f"  hint: not a terminal: compare the fingerprint with that of the {device}, then pass --yes")
        return False
    return typer.confirm(f"  Does this match the fingerprint on the {device}?")
