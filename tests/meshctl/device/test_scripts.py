"""The scripts that run on a node use only what its busybox has."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from meshctl.device import scripts
from meshctl.device.scripts import script

# Applets that OpenWrt's busybox leaves out (package/utils/busybox/Config-defaults.in).
ABSENT = """
    base64 blkid chrt cksum comm diff fold hostname install ionice mountpoint nohup nproc nsenter od paste realpath
    renice rev setsid sha1sum sha512sum shuf split stat stty tac timeout truncate tty unlink unshare usleep xxd
"""


SCRIPTS = sorted(file.name for file in Path(scripts.__file__).parent.iterdir() if file.suffix in (".sh", ".init"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_scripts_use_no_tool_that_openwrt_leaves_out(name: str) -> None:
    code = re.sub(r"^\s*#.*$", "", script(name), flags=re.MULTILINE)
    called = set(
        re.findall(r"(?:^\s*|[|;&({`]\s*|\b(?:if|then|do|else|until|while|!)\s+)([a-z][a-z0-9_-]*)", code, re.M)
    )
    assert not called & set(ABSENT.split())


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_scripts_catch_no_signal(name: str) -> None:
    """In busybox 1.38.0 the next `read` of such a script never ends."""
    caught = re.findall(r"^\s*trap (?!''|- )(?:'[^']*'|\S+) (.*)$", script(name), re.MULTILINE)
    assert set(caught) <= {"EXIT"}
