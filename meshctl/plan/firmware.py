"""Whether a node needs other firmware: the revision the inventory names against the one that runs."""

from __future__ import annotations

from meshctl.device.observation import Observation
from meshctl.firmware import is_revision
from meshctl.model import Node
from meshctl.plan.values import FirmwareStep


def firmware_step(node: Node, seen: Observation) -> FirmwareStep | None:
    """The step to the inventory's revision; None when it runs, or when the inventory names no image or revision."""
    wanted = node.hardware.firmware
    running = seen.release.revision if seen.release else ""
    if not wanted.image or not wanted.revision or is_revision(running, wanted.revision):
        return None
    return FirmwareStep(wanted.image, wanted.sha256, running or "unknown", wanted.revision)


def runs_release(node: Node, seen: Observation) -> bool:
    """Whether the node runs the release series that its configuration is rendered for; snapshots count as newest."""
    version = seen.release.version if seen.release else ""
    return version == node.release.value or version.startswith((f"{node.release.value}.", f"{node.release.value}-"))
