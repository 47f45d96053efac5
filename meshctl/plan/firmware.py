"""Whether a node needs other firmware: the revision in the inventory against the running one."""

from __future__ import annotations

from meshctl.device.observation import Observation
from meshctl.firmware import is_revision
from meshctl.model import Node
from meshctl.plan.values import FirmwareStep


def firmware_step(node: Node, observation: Observation) -> FirmwareStep | None:
    """The step to the inventory's revision; None when it is running, or the inventory names no image or revision."""
    wanted = node.hardware.firmware
    running = observation.release.revision if observation.release else ""
    if not wanted.image or not wanted.revision or is_revision(running, wanted.revision):
        return None
    return FirmwareStep(wanted.image, wanted.sha256, running or "unknown", wanted.revision)


def runs_release(node: Node, observation: Observation) -> bool:
    """Whether the node runs the release series its configuration is rendered for."""
    version = observation.release.version if observation.release else ""
    return version == node.release.value or version.startswith((f"{node.release.value}.", f"{node.release.value}-"))
