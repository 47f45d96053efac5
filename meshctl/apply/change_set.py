"""A node's plan as a change for its dead-man's switch: files with what must be there before, and the reload. Pure."""

from __future__ import annotations

import hashlib
import secrets

from meshctl.device.deadman import Change, NewFile
from meshctl.device.framing import quoted
from meshctl.device.observation import Observation
from meshctl.device.scripts import script
from meshctl.model import Backend, Fleet, Node, Secret
from meshctl.plan import DesiredState, NodePlan
from meshctl.plan.seen import file_info, package_of, text_of

# An id is part of a file's name on the node; a nonce has to be unguessable for a window of minutes.
ID_BYTES, NONCE_BYTES = 5, 16


def new_change_id() -> str:
    return "c" + secrets.token_hex(ID_BYTES)


def new_nonce() -> Secret:
    return Secret(secrets.token_hex(NONCE_BYTES))


def change_of(
    change_id: str, plan: NodePlan, desired: DesiredState, before: Observation, services: tuple[str, ...]
) -> Change:
    """The change that makes the files of `plan` what `wanted` has; the node refuses it if it is not as observed."""
    touched = {change.path for change in plan.files}
    files = {f"/{file.path}": NewFile(file.content, file.mode) for file in desired.files if file.path in touched}
    return Change(
        change_id=change_id,
        files=files,
        reload=reload_script(touched, services),
        expected={f"/{path}": _sha256_seen(path, before) for path in sorted(touched) if _is_exact(path, before)},
    )


def _is_exact(path: str, before: Observation) -> bool:
    """Whether the bytes of a file are known: text with bytes that are no UTF-8 has lost them on the way."""
    return file_info(path, before) is not None or "\ufffd" not in (text_of(path, before) or "")


def _sha256_seen(path: str, before: Observation) -> str | None:
    info = file_info(path, before)
    if info is not None:
        return info.sha256
    text = text_of(path, before)
    return None if text is None else hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


# A bat0 that was created again speaks once a second for so long: loop avoidance holds broadcasts for half a minute, and
# the batman-adv of others answers ARP requests for the node out of memory for 5 minutes (BATADV_DAT_ENTRY_TIMEOUT,
# net/batman-adv/main.h), so that no request reaches it either.
SPEAK_FRAMES = 60


def reload_script(paths: set[str], services: tuple[str, ...]) -> str:
    """POSIX sh that makes the node take up changed files and ends when the effects on who can log in are in force.

    `paths` have no leading slash; `services` are restarted besides. See scripts/reload.sh.
    """
    packages = sorted(package for path in paths if (package := package_of(path)) is not None)
    values = {"PACKAGES": " ".join(packages), "SERVICES": " ".join(services), "SPEAK_FRAMES": str(SPEAK_FRAMES)}
    return "\n".join([*(f"{name}={quoted(value)}" for name, value in values.items()), script("reload.sh")])


def services_of(fleet: Fleet, node: Node) -> tuple[str, ...]:
    """The services of back ends that bring their own: nothing but a restart is known to reload those."""
    meshes = (fleet.meshes[name] for name in node.meshes)
    named = (mesh.operator_parts.service for mesh in meshes if mesh.backend is Backend.MESHMERIZE)
    return tuple(dict.fromkeys(service for service in named if service))
