"""What a killed meshctl leaves on a node ends by itself: an armed change, an upload. And a change in one command."""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

import pytest

from meshctl.device.deadman import bundle
from meshctl.device.scripts import script
from tests.meshctl.device.changes import (
    BUNDLE,
    NONCE,
    NONCE_HASH,
    OWNER,
    change,
    is_after,
    is_before,
    prepare,
    refusal,
)
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import eventually
from tests.meshctl.device.test_deadman import LONG, OTHER, applied, armed


def test_a_started_change_is_never_taken_over(node: Sandbox) -> None:
    applied(node)
    node.deadman("unlock", OWNER)
    assert node.deadman("lock", OTHER, LONG).startswith("ok")
    assert refusal(node.deadman("stage", OTHER, "c2", BUNDLE)) == "busy"


def test_an_armed_but_unstarted_change_expires_after_its_owner_loses_the_lock(node: Sandbox) -> None:
    armed(node)
    # what `arm` starts, at the end of its time: the owner still holds the lock and may start it
    node.deadman("expire", "c1", "0")
    assert " state=armed " in node.deadman("status")
    node.deadman("unlock", OWNER)
    node.deadman("expire", "c1", "0")
    status = node.deadman("status")
    assert " state=idle " in status
    assert " last_outcome=restored last_reason=expired " in status
    assert is_before(node.path("/etc"))


def test_an_armed_change_has_an_expiry_process(node: Sandbox) -> None:
    armed(node)
    assert [command for command in map(_command_of, node.processes()) if b"\0expire\0c1\0" in command]


def _command_of(process: int) -> bytes:
    """Empty for a process that has ended since it was listed."""
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def test_another_operator_can_replace_a_change_that_was_armed_but_never_started(node: Sandbox) -> None:
    armed(node)
    # its process is gone too: the node ran out of memory
    node.close_processes()
    node.deadman("unlock", OWNER)
    assert node.deadman("lock", OTHER, LONG).startswith("ok")
    assert node.deadman("stage", OTHER, "c2", BUNDLE) == "ok state=staged id=c2"
    assert is_before(node.path("/etc"))


def test_a_new_lock_removes_the_uploads_that_a_killed_meshctl_left(node: Sandbox) -> None:
    prepare(node)
    left = ("/tmp/meshctl/c0123456789.tgz", "/tmp/meshctl/.c0123456789.tgz.0123456789abcdef.part")
    for path in left:
        node.put(path, "left behind")
    assert node.deadman("lock", OWNER, LONG).startswith("ok")
    assert [path for path in left if node.path(path).exists()] == []
    # the same owner renews its lock while its upload is under way
    node.put(left[0], "under way")
    assert node.deadman("lock", OWNER, LONG).startswith("ok")
    assert node.path(left[0]).exists()


def change_at_once(node: Sandbox, content: bytes, digest: str, limit_s: str = "60") -> str:
    """The verb `change`, with its bundle on standard input."""
    node.put("/harness/stdin", content)
    words = (OWNER, LONG, "c1", NONCE_HASH, LONG, limit_s, digest)
    done: subprocess.CompletedProcess[str] = node.run(
        "/bin/sh", "-c", 'exec /usr/sbin/meshctl-deadman change "$@" </harness/stdin', "change", *words
    )
    return done.stdout.strip()


def test_one_command_makes_the_change_and_answers_when_the_reload_has_ended(node: Sandbox) -> None:
    prepare(node)
    content = bundle(change())
    answer = change_at_once(node, content, hashlib.sha256(content).hexdigest())
    assert answer == "ok id=c1 reload_status=0"
    assert is_after(node.path("/etc"))
    # the reload has ended with the new files, and nothing of the upload is left
    assert node.text("/harness/running") == node.text("/etc/config/network")
    assert not node.path("/tmp/meshctl/c1.tgz").exists()
    assert node.deadman("confirm", "c1", NONCE, OWNER) == "ok state=idle id=c1 outcome=confirmed"
    status = node.deadman("status")
    assert " lock_owner= " in status
    assert is_after(node.path("/etc"))


def test_a_reload_that_hangs_is_not_waited_for_beyond_the_limit(node: Sandbox) -> None:
    prepare(node)
    content = bundle(change(reload="sleep 1000"))
    answer = change_at_once(node, content, hashlib.sha256(content).hexdigest(), limit_s="1")
    assert answer == "ok id=c1 reload_status="
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: is_before(node.path("/etc")))


@pytest.mark.parametrize("cut", [0, 100])
def test_a_truncated_bundle_changes_nothing_and_is_deleted(node: Sandbox, cut: int) -> None:
    prepare(node)
    content = bundle(change())
    answer = change_at_once(node, content[:cut], hashlib.sha256(content).hexdigest())
    assert refusal(answer) == "bad-bundle"
    assert is_before(node.path("/etc"))
    assert not node.path("/tmp/meshctl/c1.tgz").exists()
    assert " state=idle " in node.deadman("status")


# how often a timer that runs is taken for one that has ended, and how often one that has ended for one that runs
SEEN = """
unseen=0 dead=0
for number in $(seq 150); do
    env env env env env env env env sh -c 'while usleep 9000; do :; done; : meshctl-deadman' &
    echo $! >/tmp/pid
    for look in 1 2 3 4 5; do alive /tmp/pid || unseen=$((unseen + 1)); done
    kill $!
    wait $!
    alive /tmp/pid && dead=$((dead + 1))
done
sh -c 'usleep 300000 & echo $! >/tmp/pid; exec sleep 60' &
parent=$!
for look in $(seq 500); do
    ! grep -q 'State:.*Z' "/proc/$(cat /tmp/pid)/status" || break
    usleep 10000
done 2>/dev/null
alive /tmp/pid && zombie=alive || zombie=ended
kill $parent
echo $unseen $dead $zombie
"""


def test_a_timer_counts_as_alive_while_it_is_being_started(node: Sandbox) -> None:
    """During execve a process has no command line."""
    alive = script("deadman.sh").split("\nalive() ", 1)[1].split("\n}\n", 1)[0]
    counted = node.run("sh", "-c", f"alive() {alive}\n}}\n{SEEN}")
    assert counted.stdout.split() == ["0", "0", "ended"], counted.stderr
