"""Preconditions of changing a node, checked before anything is sent to it; each failed one has a hint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from meshctl.device.observation import Observation
from meshctl.model import Node
from meshctl.plan.cell import enabled_interfaces
from meshctl.plan.firmware import runs_release
from meshctl.plan.packages import package_name, unavailable
from meshctl.plan.values import PackageStep
from meshctl.resolve import FULL_SUPPLICANTS
from meshctl.uci import Package, masked_changes
from meshctl.wording import lock_owners


@dataclass(frozen=True, slots=True)
class FailedPrecondition:
    reason: str
    hint: str = ""


@dataclass(frozen=True, slots=True)
class _Checked:
    node: Node
    observation: Observation
    uci: Mapping[str, Package | None]
    owner: str
    is_flashed: bool
    packages: PackageStep | None
    lacking: tuple[str, ...]


def failed_precondition(
    node: Node,
    observation: Observation,
    uci: Mapping[str, Package | None],
    *,
    owner: str,
    is_flashed: bool,
    packages: PackageStep | None,
    lacking: tuple[str, ...],
) -> FailedPrecondition | None:
    """The first precondition that this node fails, or None. `owner` is our name in the node's lock, `lacking` what its
    radios cannot do of what they get."""
    case = _Checked(node, observation, uci, owner, is_flashed, packages, lacking)
    return next((found for check in _CHECKS if (found := check(case)) is not None), None)


def _writable(case: _Checked) -> FailedPrecondition | None:
    if not case.observation.root_read_only:
        return None
    return FailedPrecondition(
        "its root file system is read-only: it is in failsafe mode, or its flash has failed",
        "power-cycle it without holding a button; if that does not help, write the firmware again",
    )


def _observed(case: _Checked) -> FailedPrecondition | None:
    if case.observation.uci is None or case.observation.board is None:
        missing = "its configuration" if case.observation.uci is None else "its board"
        return FailedPrecondition(f"cannot read {missing}", "; ".join(case.observation.notes))
    return None


def _board(case: _Checked) -> FailedPrecondition | None:
    found = case.observation.board.board_name if case.observation.board else ""
    expected = case.node.hardware.board
    if found == expected:
        return None
    return FailedPrecondition(
        f"wrong board: expected {expected} ({case.node.hardware.name}), found {found or 'none'}",
        "another device answers at this address, or the node's hardware is wrong in the inventory",
    )


def _release(case: _Checked) -> FailedPrecondition | None:
    if case.is_flashed or runs_release(case.node, case.observation):
        return None
    found = case.observation.release.version if case.observation.release else "an unknown release"
    return FailedPrecondition(
        f"its configuration is for OpenWrt {case.node.release}, it runs {found}",
        "set the firmware image and revision in the inventory to have it flashed, or correct the release",
    )


def _radio_paths(case: _Checked) -> FailedPrecondition | None:
    wireless = case.uci.get("wireless")
    for radio in case.node.radios:
        section = None if wireless is None else wireless.section(radio.name)
        found = "" if section is None else section.get("path")
        if found and radio.hardware.path and found != radio.hardware.path:
            return FailedPrecondition(
                f"wrong device path of {radio.name}: expected {radio.hardware.path}, found {found}",
                "copy the path from the device into its hardware profile",
            )
    return None


def _radio_abilities(case: _Checked) -> FailedPrecondition | None:
    """Firmware may bring another driver, so a node that is flashed gets a note (`plan.node`)."""
    if case.is_flashed or not case.lacking:
        return None
    return FailedPrecondition(
        "; ".join(case.lacking),
        "change the mesh's mode or channel, or use another radio; ath10k has ad-hoc mode with ath10k-ct's firmware",
    )


def _lan_ports(case: _Checked) -> FailedPrecondition | None:
    known = case.observation.macs
    if not known:
        return None
    for port in case.node.lan_ports:
        # a VLAN (eth0.1) exists only while it is configured, its parent always
        parent = port.partition(".")[0]
        if parent not in known:
            vlan = "" if parent == port else f", on which {port} is a VLAN"
            return FailedPrecondition(
                f"it has no port {parent}{vlan}: found {', '.join(sorted(known))}",
                "correct lan_ports in its hardware profile",
            )
    return None


def _packages(case: _Checked) -> FailedPrecondition | None:
    lacking = () if case.packages is None or case.is_flashed else unavailable(case.packages)
    if not lacking:
        return None
    return FailedPrecondition(
        f"it lacks {', '.join(lacking)}, and no package file provides it",
        "build it into the image (`meshctl render --imagebuilder`), or set package_files in its hardware profile",
    )


def _supplicant(case: _Checked) -> FailedPrecondition | None:
    """Packages come before files, so the node would have to be in its encrypted mesh without the supplicant for it."""
    step = case.packages
    removed = () if step is None or case.is_flashed else step.remove
    there = {*(case.observation.packages or {}), *map(package_name, () if step is None else step.files)}
    encrypted = _encrypted_meshes(case.uci.get("wireless"))
    if not encrypted or not set(removed) & set(FULL_SUPPLICANTS) or (there - set(removed)) & set(FULL_SUPPLICANTS):
        return None
    full = ", ".join(name for name in removed if name in FULL_SUPPLICANTS)
    return FailedPrecondition(
        f"{full} would be removed while {', '.join(encrypted)} is encrypted, and the node would leave its mesh",
        "make the mesh open first, with the packages as they are; then change the packages",
    )


def _encrypted_meshes(wireless: Package | None) -> tuple[str, ...]:
    return tuple(
        face.get("ifname") or face.name or "a radio interface"
        for face, _ in enabled_interfaces(wireless)
        if face.get("mode") in ("mesh", "adhoc") and face.get("encryption", "none") != "none"
    )


def _foreign_changes(case: _Checked) -> FailedPrecondition | None:
    changes = case.observation.uci_changes
    if not changes:
        return None
    # masked as a whole: a secret may have several lines
    shown = masked_changes("\n".join(changes)).splitlines()
    return FailedPrecondition(
        f"it has uncommitted UCI changes: {'; '.join(shown[:3])}",
        "run `uci commit` or `uci revert` on the node, then plan again",
    )


def _unconfirmed_changes(case: _Checked) -> FailedPrecondition | None:
    packages = case.observation.unconfirmed_packages
    if not packages:
        return None
    return FailedPrecondition(
        f"rpcd waits for the confirmation of a change to {', '.join(packages)} (LuCI: Save & Apply), and would restore "
        f"{'it' if len(packages) == 1 else 'them'}",
        "confirm it in LuCI, or wait until rpcd has gone back, then plan again",
    )


def _other_operator(case: _Checked) -> FailedPrecondition | None:
    change = case.observation.change
    if change is None:
        return None
    if change.lock_owner and change.lock_owner != case.owner:
        left = f" for {change.lock_left_s:.0f} more seconds" if change.lock_left_s else ""
        hint = "wait until the other run ends or its lock expires"
        return FailedPrecondition(f"locked by {lock_owners(change.lock_owner)}{left}", hint)
    if change.state in ("armed", "waiting", "applied", "restoring") and change.owner != case.owner:
        return FailedPrecondition(
            f"{lock_owners(change.owner) or 'another operator'} has a change {change.state} on it",
            "wait until it has ended",
        )
    return None


_CHECKS: tuple[Callable[[_Checked], FailedPrecondition | None], ...] = (
    # in failsafe mode ubus does not answer either
    _writable,
    _observed,
    _board,
    _release,
    _radio_paths,
    _radio_abilities,
    _lan_ports,
    _packages,
    _supplicant,
    _foreign_changes,
    _unconfirmed_changes,
    _other_operator,
)
