"""A sysupgrade that someone else starts while a change is unconfirmed."""

from __future__ import annotations

from meshctl.device import deadman
from tests.meshctl.device.changes import (
    BUNDLE,
    NONCE_HASH,
    OWNER,
    is_after,
    is_before,
    prepare,
)
from tests.meshctl.device.sandbox import Sandbox

# sbin/sysupgrade, list_static_conffiles; 19.07.10 to 25.12.5 have the same `find`
SAVE = r"""
find $(sed -ne '/^[[:space:]]*$/d; /^#/d; p' /lib/upgrade/keep.d/* /tmp/base-files) \( -type f -o -type l \) |
	sort -u | sed 's,^/,,' >/tmp/files
tar -cf /tmp/sysupgrade.tar -C / $(cat /tmp/files)
"""


def test_the_new_system_returns_to_the_configuration_before_the_change(node: Sandbox) -> None:
    for path, (mode, content) in deadman.installed_files().items():
        node.put(path, content, mode)
    prepare(node)
    node.put("/tmp/base-files", "/etc/config\n/etc/dropbear\n/etc/new\n", 0o644)
    done = node.run(
        "/bin/sh",
        "-c",
        f"""
        d=/usr/sbin/meshctl-deadman
        $d lock {OWNER} 1000 && $d stage {OWNER} c1 {BUNDLE} && $d arm {OWNER} c1 {NONCE_HASH} 1000
        $d apply {OWNER} c1 now
        n=0; until [ -e /tmp/meshctl/change-c1/applied ] || [ $n -gt 600 ]; do sleep 0.1; n=$((n + 1)); done
        {SAVE}
        mkdir /tmp/seen && cp -a /etc /tmp/seen/
        kill -9 $(cat /tmp/meshctl/change-c1/*.pid)
        rm -rf /etc/meshctl /etc/config /etc/new /tmp/meshctl
        rm -f {deadman.PROGRAM} {deadman.INIT_SCRIPT} {deadman.INIT_LINK}
        tar -xf /tmp/sysupgrade.tar -C /
        [ -x {deadman.INIT_LINK} ] && $d boot
        $d status
        """,
    )
    assert is_after(node.path("/tmp/seen/etc"))
    assert is_before(node.path("/etc")), done.stdout + done.stderr
    assert "last_id=c1 last_outcome=restored last_reason=boot" in done.stdout
