"""One change that touches everything a change can: UCI, keys, an init script and its link, a new path, a removal."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from meshctl.device.deadman import Change, NewFile, bundle
from tests.meshctl.device.sandbox import Sandbox

OWNER = "alice@laptop:run-7"
NONCE = "0123456789abcdef"
NONCE_HASH = hashlib.sha256(NONCE.encode()).hexdigest()
BUNDLE = "/tmp/meshctl/change.tgz"

BEFORE = {
    "/etc/config/network": ("config interface 'lan'\n\toption ipaddr '192.168.1.1'\n", 0o644),
    "/etc/config/wireless": ("config wifi-iface 'mesh0'\n\toption ssid 'old'\n", 0o600),
    "/etc/dropbear/authorized_keys": ("ssh-ed25519 OLD\n", 0o600),
    "/etc/init.d/beacon": ("#!/bin/sh\nold\n", 0o755),
    "/etc/removed.conf": ("to be removed\n", 0o640),
}
AFTER = {
    "/etc/config/network": ("config interface 'lan'\n\toption ipaddr '10.42.0.13'\n", 0o644),
    "/etc/config/wireless": ("config wifi-iface 'mesh0'\n\toption ssid 'fleet'\n", 0o600),
    "/etc/dropbear/authorized_keys": ("ssh-ed25519 NEW\n", 0o600),
    "/etc/init.d/beacon": ("#!/bin/sh\nnew\n", 0o755),
    "/etc/new/place/of.conf": ("new\n", 0o644),
}
LINK = "/etc/rc.d/S95beacon"
TARGET = "../init.d/beacon"
# what the services run with after a reload: proves that reload ran, and with which files
RELOAD = "cat /etc/config/network >/harness/running"


def change(change_id: str = "c1", reload: str = RELOAD) -> Change:
    expected = {path: hashlib.sha256(text.encode()).hexdigest() for path, (text, _) in BEFORE.items()}
    return Change(
        change_id=change_id,
        files={path: NewFile(text.encode(), mode) for path, (text, mode) in AFTER.items()},
        reload=reload,
        links={LINK: TARGET},
        removed=("/etc/removed.conf",),
        expected={**expected, "/etc/new/place/of.conf": None, LINK: None},
    )


def prepare(node: Sandbox, wanted: Change | None = None) -> None:
    """The node as it was before, and the bundle uploaded."""
    for path, (text, mode) in BEFORE.items():
        node.put(path, text, mode)
    node.put(BUNDLE, bundle(wanted or change()))


def live(etc: Path) -> dict[str, tuple[str, int]]:
    """What the touched paths hold below this /etc; absent ones are missing."""
    found: dict[str, tuple[str, int]] = {}
    for path in {*BEFORE, *AFTER}:
        file = etc / path.removeprefix("/etc/")
        if file.is_file():
            found[path] = (file.read_text(), file.stat().st_mode & 0o7777)
    link = etc / LINK.removeprefix("/etc/")
    if link.is_symlink():
        found[LINK] = (os.readlink(link), 0)
    return found


def is_before(etc: Path) -> bool:
    """Exactly the old state: nothing of the change is left, not even its directories."""
    return live(etc) == BEFORE and not (etc / "new").exists()


def is_after(etc: Path) -> bool:
    """Exactly the new state."""
    return live(etc) == {**AFTER, LINK: (TARGET, 0)}


def refusal(answer: str) -> str:
    words = answer.split()
    assert words[0] == "refused", answer
    return words[1]
