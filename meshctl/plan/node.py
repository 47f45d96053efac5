"""The plan of one node: desired state against observation -> `NodePlan`.

`node_plan` checks the preconditions, then finds the firmware step, the package step, the files that differ, what their
reload interrupts, and whether the node would leave the cell of its mesh. A second plan after an apply is empty.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from meshctl.device.connection import OwnKey
from meshctl.device.observation import Observation
from meshctl.model import Node
from meshctl.plan.abilities import lacking_abilities
from meshctl.plan.cell import cells, partitions
from meshctl.plan.effects import effects
from meshctl.plan.firmware import firmware_step
from meshctl.plan.left_over import interface_names, left_over
from meshctl.plan.lockout import firewall_notes, lockout, server_lockout
from meshctl.plan.masking import Fingerprints, masked_text, secrets_of
from meshctl.plan.observed_files import file_info, fingerprint_texts, is_meshed, packages_seen, parsed, text_of
from meshctl.plan.packages import NO_NEEDS, Needs, other_versions, package_step
from meshctl.plan.preconditions import failed_precondition
from meshctl.plan.values import Cut, Effect, FileChange, FirmwareStep, NodePlan, Verdict
from meshctl.render import LAN_FILTER_PATH, LINKS_PATH, MARKER_PATH, RenderedFile
from meshctl.resolve import wireless_scripts
from meshctl.uci import Package

PUBLIC_FILES = (LAN_FILTER_PATH, LINKS_PATH, MARKER_PATH, "etc/dropbear/authorized_keys")


@dataclass(frozen=True, slots=True)
class DesiredState:
    """The desired state of one node: its rendered files, the secrets in them, its packages and the files that may bring
    them. `departs`: the meshes whose cell in the inventory it leaves, as an earlier state may."""

    node: Node
    files: Sequence[RenderedFile] = field(repr=False)
    secrets: tuple[str, ...] = field(repr=False, default=())
    needs: Needs = NO_NEEDS
    package_files: tuple[str, ...] = ()
    departs: tuple[str, ...] = ()

    @property
    def paths(self) -> tuple[str, ...]:
        return tuple(file.path for file in self.files)


def node_plan(
    desired: DesiredState,
    observation: Observation | None,
    fingerprints: Fingerprints,
    *,
    unreachable: str = "",
    owner: str = "",
    with_firmware: bool = True,
    own_keys: Sequence[OwnKey] | None = None,
) -> NodePlan:
    """The plan of one node. `seen` is None for a node that did not answer, and `unreachable` is the reason; `owner` is
    our name in its lock; `own_keys` are checked for a lockout (None: not checked)."""
    node = desired.node
    target = fingerprints.of(
        {file.path: f"{file.mode:o} " + file.content.decode("utf-8", "surrogateescape") for file in desired.files},
        desired.secrets,
    )
    if observation is None:
        return NodePlan(node.name, Verdict.AWAY, unreachable or "did not answer", meshes=node.meshes, wanted=target)
    before = packages_seen(desired.paths, observation)
    after = {file.package.name: file.package for file in desired.files if file.package is not None}
    live = cells(before.get("wireless"), before.get("network"))
    old_secrets = (secret for package in before.values() if package is not None for secret in secrets_of(package))
    live_after = cells(after.get("wireless"), after.get("network"))
    partition = partitions(live, live_after)
    basis = NodePlan(
        node.name,
        Verdict.SAME,
        splits=tuple(f"{radio}: {reason}" for radio, all_of_it in partition.items() for reason in all_of_it),
        parted_from=meshes_of(node, partition),
        departs=desired.departs,
        meshes=node.meshes,
        has_cell=bool(live),
        is_meshed=is_meshed(observation, live),
        observed=fingerprints.of(fingerprint_texts(desired.paths, observation), (*desired.secrets, *old_secrets)),
        wanted=target,
    )
    firmware = firmware_step(node, observation) if with_firmware else None
    packages = package_step(desired.needs, observation, desired.package_files)
    lacking = lacking_abilities(node, observation, before.get("wireless"), after.get("wireless"))
    problem = failed_precondition(
        node, observation, before, owner=owner, is_flashed=firmware is not None, packages=packages, lacking=lacking
    )
    if problem is not None:
        return replace(basis, verdict=Verdict.REFUSED, reason=problem.reason, hint=problem.hint)
    files = file_changes(desired.files, observation)
    contents = {file.path: file.content for file in desired.files} if files or firmware else {}
    locked_out = None if own_keys is None else lockout(node, contents, own_keys)
    if locked_out is None and contents:
        locked_out = server_lockout(node, after)
    if locked_out is not None:
        return replace(basis, verdict=Verdict.REFUSED, reason=locked_out.reason, hint=locked_out.hint)
    node_effects = effects((change.path for change in files), before, after, node.release)
    wanted_on = interface_names(after.get("wireless"))
    still_on = () if firmware is not None else tuple(name for name in left_over(observation) if name not in wanted_on)
    if still_on:
        why = f"{', '.join(still_on)}: turned off by its configuration, but on the air: taken down"
        node_effects = (*node_effects, Effect("wifi", Cut.MESH, why))
    if packages is not None and packages.remove:
        why = f"all radios restart, because {', '.join(packages.remove)} is replaced"
        node_effects = (*node_effects, Effect("wifi", Cut.MESH, why))
    if firmware is not None:
        node_effects = (
            Effect("firmware", Cut.NODE, f"{firmware.from_revision} -> {firmware.to_revision}"),
            *node_effects,
        )
    return replace(
        basis,
        verdict=Verdict.CHANGE if files or still_on or firmware or packages else Verdict.SAME,
        firmware=firmware,
        packages=packages,
        files=files,
        left_over=still_on,
        effects=node_effects,
        notes=(
            *observation.notes,
            *_tagged_ports(node, observation, after.get("network")),
            *(firewall_notes(node, after) if contents else ()),
            *_lacking_scripts(node, observation, basis, firmware),
            *_lasting_thresholds(before.get("wireless"), after.get("wireless"), firmware),
            *(f"{text}; the new firmware must include another driver" for text in lacking),
            *_other_target(node, observation),
            *(other_versions(observation, desired.package_files) if firmware is None else ()),
        ),
    )


def meshes_of(node: Node, radios: Iterable[str]) -> tuple[str, ...]:
    """The meshes of these radios; all of the node's if a radio is not in the inventory."""
    mesh_of = {radio.name: radio.mesh for radio in node.radios}
    names = set(radios)
    if not names <= set(mesh_of):
        return node.meshes
    return tuple(dict.fromkeys(mesh for name, mesh in mesh_of.items() if name in names and mesh is not None))


def _tagged_ports(node: Node, observation: Observation, network: Package | None) -> tuple[str, ...]:
    """Ports to a switch that accepts only tagged frames: the inventory names eth0, the board eth0.1."""
    if network is None or observation.board is None or not any(network.of_type("switch_vlan")):
        return ()
    parents = {port.partition(".")[0]: port for port in observation.board.lan_ports if "." in port}
    return tuple(
        f"{port} connects to a switch whose LAN is {parents[port]}: devices on its ports will be unreachable; "
        "correct lan_ports"
        for port in node.lan_ports
        if port in parents
    )


def _lacking_scripts(
    node: Node, observation: Observation, basis: NodePlan, firmware: FirmwareStep | None
) -> tuple[str, ...]:
    """A note if the package with the wireless scripts is missing. A node in its mesh has them, by whatever name."""
    package = wireless_scripts(node.release)
    if package is None or firmware is not None or observation.packages is None or package in observation.packages:
        return ()
    if basis.is_meshed or not node.meshes:
        return ()
    return (
        f"it lacks {package}: without its /usr/share/hostap/wdev.uc OpenWrt {node.release} brings up no mesh "
        "interface, and the node would roll back. Build the image with it",
    )


def _other_target(node: Node, observation: Observation) -> tuple[str, ...]:
    """A note if the device runs an image of another target. Releases rename targets, so a flash is not refused; the
    image's own check compares its boards (`sysupgrade`)."""
    found = observation.release.target if observation.release else ""
    if not found or not node.hardware.target or found == node.hardware.target:
        return ()
    return (
        f"it runs an image for {found}, its profile says {node.hardware.target}: an image for another chip does not "
        "boot; correct target in its hardware profile",
    )


def _lasting_thresholds(
    before: Package | None, after: Package | None, firmware: FirmwareStep | None
) -> tuple[str, ...]:
    """Thresholds of radios that are removed: OpenWrt's scripts set them only if present, so the driver keeps them."""
    if before is None or after is None or firmware is not None:
        return ()
    return tuple(
        f"{radio.name}: {option} {radio.get(option)} is removed, but stays in force until the node reboots"
        for radio in before.of_type("wifi-device")
        for option in ("rts", "frag")
        if radio.get(option) and ((new := after.section(radio.name or "")) is None or not new.get(option))
    )


def file_changes(files: Sequence[RenderedFile], observation: Observation) -> tuple[FileChange, ...]:
    """The files that differ from the desired ones, each with a masked diff.

    UCI packages are compared as trees: quoting, comments and blank lines make no difference to OpenWrt.
    """
    return tuple(change for file in files if (change := _file_change(file, observation)) is not None)


def _file_change(file: RenderedFile, observation: Observation) -> FileChange | None:
    live = text_of(file.path, observation)
    if file.package is not None:
        return _package_change(file.path, file.package, live)
    info = file_info(file.path, observation)
    if info is None:
        return FileChange(file.path, "added", _diff(file.path, "", file.masked))
    content = file.content.decode("utf-8", "surrogateescape")
    if live == content and info.mode == file.mode:
        return None
    if live == content:
        return FileChange(file.path, "changed", f"mode {info.mode:04o} -> {file.mode:04o}\n")
    # the current file may hold unknown secrets, so only files that are public by nature are shown
    old = live if live is not None and file.path in PUBLIC_FILES else "(not shown)\n"
    return FileChange(file.path, "changed", _diff(file.path, old, file.masked))


def _package_change(path: str, desired: Package, live: str | None) -> FileChange | None:
    if live is None:
        return FileChange(path, "added", _diff(path, "", masked_text(desired)))
    current = parsed(live, desired.name)
    if current is None:
        return FileChange(path, "changed", f"--- a/{path}\n(not readable as UCI)\n+++ b/{path}\n")
    if current == desired:
        return None
    old = masked_text(current, differing_from=desired)
    return FileChange(path, "changed", _diff(path, old, masked_text(desired)))


def _diff(path: str, old: str, new: str) -> str:
    lines = difflib.unified_diff(old.splitlines(), new.splitlines(), f"a/{path}", f"b/{path}", lineterm="", n=2)
    return "".join(f"{line}\n" for line in lines)
