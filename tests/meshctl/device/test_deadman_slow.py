"""A loaded node whose flash is slow: neither its second timer nor its lock ends a change that is under way."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from meshctl.device.deadman import bundle
from tests.meshctl.device.changes import NONCE, NONCE_HASH, OWNER, change, is_after, prepare
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import eventually
from tests.meshctl.device.test_deadman import LONG, applied, armed, last, state, uptime_s

# a sync that takes until the test lets it end
SLOW_SYNC = """#!/bin/sh
[ -e /harness/slow ] || exit 0
: >/harness/syncing
while [ -e /harness/slow ]; do usleep 20000; done
"""


def waits(node: Sandbox, due_cs: str) -> bool:
    """Whether the second timer with this due time has judged the change and waits, for which it opens a FIFO."""
    for process in node.processes():
        with suppress(OSError):
            own = Path("/proc", str(process))
            words = (own / "cmdline").read_bytes().split(b"\0")
            opened = (os.readlink(each) for each in (own / "fd").iterdir())
            if due_cs.encode() in words and any(name.endswith("/pause") for name in opened):
                return True
    return False


@pytest.mark.parametrize("is_slow", [True, False])
def test_the_second_timer_leaves_a_change_alone_whose_files_take_longer_to_move(node: Sandbox, is_slow: bool) -> None:
    """The first one counts the window from when the files were in place, the second one counted from the start."""
    node.put("/bin/sync", SLOW_SYNC, 0o755)
    armed(node)
    if is_slow:
        node.put("/harness/slow", "")
    assert node.deadman("apply", OWNER, "c1", "now").startswith("ok")
    eventually(lambda: node.path("/harness/syncing").exists() if is_slow else state(node) == "applied")
    # as long ago as the window and the grace of the second timer take, or far longer once the window is open
    due_cs = f"{(uptime_s() - float(LONG) - 60.0) * 100 if is_slow else -1e11:.0f}"
    with ThreadPoolExecutor(1) as pool:
        guard = pool.submit(node.deadman, "guard", "c1", due_cs)
        eventually(lambda: guard.done() or waits(node, due_cs))
        node.path("/harness/slow").unlink(missing_ok=True)
        eventually(lambda: state(node) in {"applied", "idle"})
        node.deadman("confirm", "c1", NONCE)
        guard.result(60)
    assert last(node) == ("c1", "confirmed", "operator")
    assert is_after(node.path("/etc"))


# reloads for as long as the new files are there, unless it is stopped
ENDLESS = """echo $$ >>/harness/reloads
while grep -q 10.42.0.13 /etc/config/network; do usleep 50000; done
sleep 600
"""


def test_a_reload_whose_timer_was_killed_is_stopped_before_the_restored_files_are_reloaded(node: Sandbox) -> None:
    """Otherwise both run, and the end of the first one counts as that of the second one."""
    applied(node, wanted=change(reload=ENDLESS))
    eventually(lambda: bool(node.text("/harness/reloads")))
    (watch,) = (int(text) for text in (node.text("/tmp/meshctl/change-c1/watch.pid") or "").split())
    os.kill(watch, signal.SIGKILL)
    eventually(lambda: state(node) == "orphaned")
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: len((node.text("/harness/reloads") or "").split()) == 2)
    first, second = (int(text) for text in (node.text("/harness/reloads") or "").split())
    running = node.processes()
    assert (first in running, second in running) == (False, True)
    assert last(node) == ("c1", "restored", "abort")


def test_a_lock_that_expires_while_the_bundle_arrives_is_renewed(node: Sandbox) -> None:
    """Before, the node refused: `not-locked`, take the lock first."""
    prepare(node)
    content = bundle(change())
    words = (OWNER, LONG, "c1", NONCE_HASH, LONG, "60", hashlib.sha256(content).hexdigest())
    with subprocess.Popen(
        node.argv("/usr/sbin/meshctl-deadman", "change", *words), stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        eventually(lambda: node.path("/tmp/meshctl/lock.1").exists() and node.path("/tmp/meshctl/c1.tgz").exists())
        owner, _, boot = (node.text("/tmp/meshctl/lock.1") or "").split()
        node.put("/tmp/meshctl/lock.1", f"{owner} 1 {boot}\n")
        out, _ = process.communicate(content, timeout=120)
    assert out.decode().strip() == "ok id=c1 reload_status=0"
    assert f" lock_owner={OWNER} " in node.deadman("status")
