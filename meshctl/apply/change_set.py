"""A node's plan as a change for its dead-man's switch: files, their expected previous hashes, the reload. Pure."""

from __future__ import annotations

import hashlib
import secrets

from meshctl.device.deadman import Change, NewFile
from meshctl.device.framing import quoted
from meshctl.device.observation import Observation
from meshctl.device.scripts import script
from meshctl.model import Backend, Fleet, Node, Secret
from meshctl.plan import DesiredState, NodePlan
from meshctl.plan.effects import loaded_package
from meshctl.plan.observed_files import WIRELESS, file_info, packages_seen, text_of
from meshctl.plan.radios import EVERY_RADIO, NO_RADIOS, Radios, restarting_radios

# The id is part of a file name on the node; the nonce must be unguessable for a confirm window of minutes.
ID_BYTES, NONCE_BYTES = 5, 16


def new_change_id() -> str:
    return "c" + secrets.token_hex(ID_BYTES)


def new_nonce() -> Secret:
    return Secret(secrets.token_hex(NONCE_BYTES))


def change_of(
    change_id: str, plan: NodePlan, desired: DesiredState, before: Observation, services: tuple[str, ...]
) -> Change:
    """The change that writes the files of `plan`; the node refuses it if they differ from what was observed."""
    touched = {change.path for change in plan.files}
    files = {f"/{file.path}": NewFile(file.content, file.mode) for file in desired.files if file.path in touched}
    return Change(
        change_id=change_id,
        files=files,
        # a reload of this package takes down what is left over
        reload=reload_script(touched | {WIRELESS} if plan.left_over else touched, services),
        expected={f"/{path}": _sha256_seen(path, before) for path in sorted(touched) if _is_exact(path, before)},
    )


def _is_exact(path: str, before: Observation) -> bool:
    """Whether a file's bytes are known: decoding replaces those that are not UTF-8."""
    return file_info(path, before) is not None or "\ufffd" not in (text_of(path, before) or "")


def _sha256_seen(path: str, before: Observation) -> str | None:
    info = file_info(path, before)
    if info is not None:
        return info.sha256
    text = text_of(path, before)
    return None if text is None else hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


# How many frames, one per second, a recreated bat0 sends: loop avoidance holds its broadcasts for 30 s, and other nodes
# answer ARP requests for it from their cache for 5 minutes (BATADV_DAT_ENTRY_TIMEOUT, net/batman-adv/main.h), so no
# request makes it answer.
SPEAK_FRAMES = 60


def reload_script(paths: set[str], services: tuple[str, ...]) -> str:
    """POSIX sh that reloads the changed files and returns once their effects on logins are in force.

    `paths` have no leading slash; `services` are restarted in addition. See scripts/reload.sh.
    """
    packages = sorted({package for path in paths if (package := loaded_package(path)) is not None})
    values = {"PACKAGES": " ".join(packages), "SERVICES": " ".join(services), "SPEAK_FRAMES": str(SPEAK_FRAMES)}
    return "\n".join([*(f"{name}={quoted(value)}" for name, value in values.items()), script("reload.sh")])


def services_of(fleet: Fleet, node: Node) -> tuple[str, ...]:
    """The services of back ends with their own daemon; only a restart is known to reload them."""
    meshes = (fleet.meshes[name] for name in node.meshes)
    named = (mesh.operator_parts.service for mesh in meshes if mesh.backend is Backend.MESHMERIZE)
    return tuple(dict.fromkeys(service for service in named if service))


def radios_of(plan: NodePlan, desired: DesiredState, before: Observation) -> Radios:
    """The radios that may restart with the plan's changes. Where one is left over, all may be taken down and up."""
    if plan.left_over:
        return EVERY_RADIO
    if not any(change.path == WIRELESS for change in plan.files):
        return NO_RADIOS
    seen = packages_seen([WIRELESS], before)["wireless"]
    return restarting_radios(seen, next((file.package for file in desired.files if file.path == WIRELESS), None))
