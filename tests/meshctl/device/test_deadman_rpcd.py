"""LuCI's own way back, `uci apply` of rpcd: its snapshot in RAM, which its timer copies over /etc/config."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.meshctl.device.changes import AFTER, BEFORE, BUNDLE, OWNER, change, prepare, refusal
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import eventually
from tests.meshctl.device.test_deadman import LONG, applied

SNAPSHOT = "/var/run/rpcd/snapshot-files"
NETWORK = "/etc/config/network"
# answers of `ubus call uci confirm` under another session's name, recorded on 24.10.7 and 25.12.5; the exit status was
# 250 and 251 (it is 6 and 5 with older versions of ubus)
WAITS = "Command failed: ubus call uci confirm {...} (Permission denied)"
NO_TIMER = "Command failed: ubus call uci confirm {...} (No response)"
NO_RPCD = "Command failed: Not found"


def _rpcd_says(node: Sandbox, answer: str) -> None:
    node.put("/bin/ubus", f"#!/bin/sh\n[ \"$5\" != confirm ] || {{ echo '{answer}' >&2; exit 5; }}\n", 0o755)


def test_a_change_that_rpcd_would_take_back_is_refused(node: Sandbox) -> None:
    prepare(node)
    node.deadman("lock", OWNER, LONG)
    node.put(f"{SNAPSHOT}/wireless", "config wifi-device 'radio0'\n")
    _rpcd_says(node, WAITS)
    answer = node.deadman("stage", OWNER, "c1", BUNDLE)
    assert refusal(answer) == "foreign-changes"
    assert "a change to wireless" in answer


@pytest.mark.parametrize("answer", [NO_TIMER, NO_RPCD])
def test_a_snapshot_without_a_timer_refuses_nothing(node: Sandbox, answer: str) -> None:
    """LuCI's "Apply unchecked" leaves one until the next boot."""
    prepare(node)
    node.deadman("lock", OWNER, LONG)
    node.put(f"{SNAPSHOT}/wireless", "config wifi-device 'radio0'\n")
    _rpcd_says(node, answer)
    assert node.deadman("stage", OWNER, "c1", BUNDLE).startswith("ok")


def test_a_timer_of_rpcd_that_began_in_the_window_ends_with_the_restored_files(node: Sandbox) -> None:
    """Otherwise the files that locked the operators out would come back after they were restored."""
    both = change()
    added = "/etc/config/added"
    files, expected = {**both.files, added: both.files[NETWORK]}, {**both.expected, added: None}
    applied(node, wanted=replace(both, files=files, expected=expected))
    for path in (NETWORK, added):
        node.put(f"{SNAPSHOT}/{path.rpartition('/')[2]}", AFTER[NETWORK][0])
    node.put(f"{SNAPSHOT}/system", "config system\n")
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: " state=idle " in node.deadman("status"))
    assert node.text(NETWORK) == BEFORE[NETWORK][0]
    assert node.text(f"{SNAPSHOT}/network") == BEFORE[NETWORK][0]
    assert node.text(f"{SNAPSHOT}/system") == "config system\n"
    # what rpcd's snapshot did not have is not put there, and what did not exist before does not come back
    assert sorted(path.name for path in node.path(SNAPSHOT).iterdir()) == ["network", "system"]
