"""What the dead-man's switch does on a node whose flash or memory is full."""

from __future__ import annotations

import re
import shutil

from meshctl.device.parse.deadman import parse_status
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

FULL = """\
cp -a /etc /tmp/etc
mount -t tmpfs -o size={size}k tmpfs /etc
cp -a /tmp/etc/. /etc
/usr/sbin/meshctl-deadman lock {owner} 1000 >/dev/null
{script}
cp -a /etc/. /tmp/after
"""


def on_small_flash(node: Sandbox, size_kib: int, steps: str) -> str:
    """Run `steps` with /etc on a file system of that size; what is then in it is kept in /tmp/after."""
    node.path("/tmp/after").mkdir()
    done = node.run("/bin/sh", "-c", FULL.format(size=size_kib, owner=OWNER, script=steps))
    return done.stdout.strip()


def test_a_full_flash_is_noticed_before_anything_changes(node: Sandbox) -> None:
    prepare(node)
    answer = on_small_flash(node, 96, f"/usr/sbin/meshctl-deadman stage {OWNER} c1 {BUNDLE}")
    assert refusal(answer) == "flash-full"
    assert re.search(r"needs \d+ KiB of flash, \d+ KiB are free", answer)
    assert is_before(node.path("/tmp/after"))
    assert not (node.path("/tmp/after") / "meshctl/change").exists()


def test_a_flash_that_fills_up_later_does_not_block_the_rollback(node: Sandbox) -> None:
    prepare(node)
    answer = on_small_flash(
        node,
        1024,
        f"""
        d=/usr/sbin/meshctl-deadman
        $d stage {OWNER} c1 {BUNDLE} && $d arm {OWNER} c1 {NONCE_HASH} 0
        mkdir -p /tmp/meshctl/change-c1
        sed 's/^put_previous() {{/&\\nfill/' $d >/tmp/filled
        echo 'fill() {{ cat /dev/zero >/etc/filler 2>/dev/null; df -k /etc >/tmp/df; }}' >/tmp/start
        cat /tmp/start /tmp/filled >/tmp/full.sh
        sh /tmp/full.sh watch c1 0
        awk 'END {{ print "free", $(NF - 2) }}' /tmp/df
        rm -f /etc/filler
        """,
    )
    assert "ok state=armed id=c1" in answer
    assert "free 0" in answer
    assert is_before(node.path("/tmp/after"))


STARTED = f"""
d=/usr/sbin/meshctl-deadman
fill() {{{{ cat /dev/zero >/etc/filler 2>/dev/null; }}}}
$d stage {OWNER} c0 {BUNDLE} && $d arm {OWNER} c0 {NONCE_HASH} 1000 && $d abort {OWNER} c0
$d stage {OWNER} c1 {BUNDLE} && $d arm {OWNER} c1 {NONCE_HASH} {{window_s}}
"""


def last_of(answer: str) -> tuple[str, str, str]:
    status = parse_status(answer.splitlines()[-1])
    assert status is not None
    return status.last_id, status.last_outcome, status.last_reason


def test_a_flash_that_is_full_at_the_confirmation_keeps_its_outcome(node: Sandbox) -> None:
    """Otherwise an owner who has lost the answer finds no trace of the change, and starts it again."""
    prepare(node)
    answer = on_small_flash(
        node,
        1024,
        f"""{STARTED.format(window_s=1000)}
        $d apply {OWNER} c1 now
        until $d status | grep -q state=applied; do sleep 0.1; done
        fill
        $d confirm c1 {NONCE} >/dev/null
        $d confirm c1 {NONCE}
        $d status
        """,
    )
    assert last_of(answer) == ("c1", "confirmed", "operator")
    assert answer.splitlines()[-2] == "ok state=idle id=c1 outcome=confirmed"
    assert is_after(node.path("/tmp/after"))
    assert not (node.path("/tmp/after") / "meshctl/change").exists()


def test_a_flash_that_is_full_at_the_end_of_a_rollback_keeps_its_outcome(node: Sandbox) -> None:
    prepare(node)
    answer = on_small_flash(
        node,
        1024,
        f"""{STARTED.format(window_s=0)}
        sed 's/^write_last() {{/&\\nfill/' $d >/tmp/filled
        {{ echo 'fill() {{ cat /dev/zero >/etc/filler 2>/dev/null; }}'; cat /tmp/filled; }} >/tmp/full.sh
        mkdir -p /tmp/meshctl/change-c1
        sh /tmp/full.sh watch c1 0
        $d status
        """,
    )
    assert last_of(answer) == ("c1", "restored", "unknown")
    assert is_before(node.path("/tmp/after"))


def on_small_memory(node: Sandbox, script: str) -> list[str]:
    """The lines that `script` says where /tmp/meshctl has 16 KiB; `fill` takes what is left."""
    start = "mkdir -p /tmp/meshctl && mount -t tmpfs -o size=16k tmpfs /tmp/meshctl || exit 9\n"
    done = node.run("sh", "-c", f"{start}fill() {{ cat /dev/zero >/tmp/meshctl/filler 2>/dev/null; }}\n{script}")
    assert done.returncode != 9, done.stderr
    return done.stdout.splitlines()


def test_a_lock_that_could_not_be_written_is_refused(node: Sandbox) -> None:
    first, second = on_small_memory(
        node,
        f"""
        fill
        /usr/sbin/meshctl-deadman lock {OWNER} 60
        rm /tmp/meshctl/filler
        /usr/sbin/meshctl-deadman lock {OWNER} 60
        """,
    )
    assert first == "refused tmp-full no room in /tmp/meshctl to write the lock"
    assert second.startswith("ok")


def test_a_lock_can_be_released_with_full_memory(node: Sandbox) -> None:
    *_, given_back, taken = on_small_memory(
        node,
        f"""
        /usr/sbin/meshctl-deadman lock {OWNER} 6000
        fill
        /usr/sbin/meshctl-deadman unlock {OWNER}
        rm /tmp/meshctl/filler
        /usr/sbin/meshctl-deadman lock somebody@else 60
        """,
    )
    assert given_back == "ok"
    assert taken == "ok lock_owner=somebody@else"


def test_with_full_memory_a_change_and_its_rollback_reload_completely(node: Sandbox) -> None:
    # of a script that was copied into a full /tmp nothing was run, and nothing is a success
    prepare(node, change(reload="echo reloaded >>/harness/log\n" + f"# {'x' * 70}\n" * 80))
    shutil.copy(node.path(BUNDLE), node.path("/harness/bundle"))
    answers = on_small_memory(
        node,
        f"""
        d=/usr/sbin/meshctl-deadman
        $d lock {OWNER} 6000 && $d stage {OWNER} c1 /harness/bundle && $d arm {OWNER} c1 {NONCE_HASH} 1
        mkdir -p /tmp/meshctl/change-c1
        fill
        $d watch c1 0
        """,
    )
    assert answers[-1] == "ok state=armed id=c1"
    assert is_before(node.path("/etc"))
    assert node.text("/harness/log") == "reloaded\n" * 2
    # there was no room for its exit status; booting also empties /tmp
    assert node.text("/harness/reboots") == "reboot\n"
