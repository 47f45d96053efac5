"""LuCI's "Save & Apply" on a virtual node that has rpcd, as its calls over ubus."""

from __future__ import annotations

import json

from meshlab.fleet import VirtualNode
from tests.waiting import until

SNAPSHOT = "/var/run/rpcd/snapshot-files"


def call(node: VirtualNode, path: str, method: str, **arguments: object) -> tuple[int, str]:
    """The exit status of `ubus call`, and what it printed."""
    done = node.exec(f"ubus call {path} {method} '{json.dumps(arguments)}'")
    return done.exit_status, done.stdout + done.stderr


def log_in(node: VirtualNode) -> str:
    """The id of a session that may read and write every package."""
    _, text = call(node, "session", "create")
    session = str(json.loads(text)["ubus_rpc_session"])
    objects = [["*", "read"], ["*", "write"]]
    assert call(node, "session", "grant", ubus_rpc_session=session, scope="uci", objects=objects)[0] == 0
    return session


def edit(node: VirtualNode, session: str, package: str, section: str, **values: str) -> None:
    """Set options; nothing is committed yet."""
    arguments = {"ubus_rpc_session": session, "config": package, "section": section, "values": values}
    assert call(node, "uci", "set", **arguments) == (0, "")


def save_and_apply(node: VirtualNode, session: str, *, rollback_s: int | None) -> None:
    """`rollback_s` None: "Apply unchecked"."""
    how = {"rollback": False} if rollback_s is None else {"rollback": True, "timeout": rollback_s}
    assert call(node, "uci", "apply", ubus_rpc_session=session, **how) == (0, "")


def waits(node: VirtualNode) -> bool:
    """Whether rpcd waits for a confirmation, which it refuses to other sessions."""
    return "Permission denied" in call(node, "uci", "confirm", ubus_rpc_session="somebody")[1]


def await_rollback(node: VirtualNode) -> None:
    until(lambda: not waits(node), "rpcd's timer to end", wait_s=300.0)
