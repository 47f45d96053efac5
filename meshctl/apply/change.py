"""A node's plan as a change for its dead-man's switch: files with what must be there before, and the reload. Pure."""

from __future__ import annotations

import hashlib
import secrets

from meshctl.device.deadman import Change, NewFile
from meshctl.device.observation import Observation
from meshctl.model import Backend, Fleet, Node, Secret
from meshctl.plan import NodePlan, Wanted
from meshctl.plan.seen import file_info, package_of, text_of

# An id is part of a file's name on the node; a nonce has to be unguessable for a window of minutes.
ID_BYTES, NONCE_BYTES = 5, 16


def new_change_id() -> str:
    return "c" + secrets.token_hex(ID_BYTES)


def new_nonce() -> Secret:
    return Secret(secrets.token_hex(NONCE_BYTES))


def change_of(change_id: str, plan: NodePlan, wanted: Wanted, before: Observation, services: tuple[str, ...]) -> Change:
    """The change that makes the files of `plan` what `wanted` has; the node refuses it if it is not as observed."""
    touched = {change.path for change in plan.files}
    files = {f"/{file.path}": NewFile(file.content, file.mode) for file in wanted.files if file.path in touched}
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


# netifd reads /lib/netifd/proto once, when it starts (proto_shell_init, 19.07 to 25.12): where the package came later,
# it does not know batman-adv, and a reload leaves bat0 unmade.
_LEARN_BATMAN = (
    "if grep -q batadv /etc/config/network && known=$(ubus call network get_proto_handlers 2>/dev/null); then",
    "\tcase $known in *'\"batadv\"'*) ;; *) /etc/init.d/network restart || status=$? ;; esac",
    "fi",
)


# bat0 that was made anew knows nobody behind it, and tells the mesh of the node's own address only once the node has
# sent something through it. Where br-lan has other ports, nothing makes it: its link never went down. Meanwhile the
# batman-adv of others answers ARP requests for it out of memory, for 5 minutes (BATADV_DAT_ENTRY_TIMEOUT,
# net/batman-adv/main.h), so nobody calls aloud either. Loop avoidance holds broadcasts for half a minute, but not what
# goes to one station. So the node speaks to whom it was just spoken to by, each second until bat0 is surely there.
SPEAK_FRAMES = 60
_SPEAK = f'[ -z "$SSH_CONNECTION" ] || ping -c {SPEAK_FRAMES} "${{SSH_CONNECTION%% *}}" >/dev/null 2>&1 </dev/null &'


def reload_script(paths: set[str], services: tuple[str, ...]) -> str:
    """POSIX sh that makes the node take up changed files; reload_config reloads the services whose package changed."""
    lines = ["status=0"]
    if any(package_of(path) is not None for path in paths):
        lines.append("reload_config || status=$?")
    if "etc/config/network" in paths:
        lines += [*_LEARN_BATMAN, _SPEAK]
    lines += [f"/etc/init.d/{service} restart || status=$?" for service in services]
    return "\n".join([*lines, "exit $status"]) + "\n"


def services_of(fleet: Fleet, node: Node) -> tuple[str, ...]:
    """The services of back ends that bring their own: nothing but a restart is known to reload those."""
    meshes = (fleet.meshes[name] for name in node.meshes)
    named = (mesh.operator_parts.service for mesh in meshes if mesh.backend is Backend.MESHMERIZE)
    return tuple(dict.fromkeys(service for service in named if service))
