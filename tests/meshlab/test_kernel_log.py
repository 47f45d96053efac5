"""Which tasks of a machine's kernel are stuck, from its console."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from meshlab.client import request
from meshlab.errors import LabError
from meshlab.kernel_log import blocked_tasks

# of Linux 6.1, shortened
_REPORT = """\
[  363.580190] br-lan: port 1(eth0) entered forwarding state
[  363.580195] INFO: task kworker/2:3:722 blocked for more than 120 seconds.
[  363.580196]       Not tainted 6.1.0-56-amd64 #1 Debian 6.1.192-2
[  363.580198] "echo 0 > /proc/sys/kernel/hung_task_timeout_secs" disables this message.
[  363.580199] task:kworker/2:3     state:D stack:0     pid:722   ppid:2      flags:0x00004000
[  363.580201] Workqueue: ipv6_addrconf addrconf_verify_work
[  363.580204] Call Trace:
[  363.580204]  <TASK>
[  363.580205]  __schedule+0x34d/0x9e0
[  363.580207]  schedule+0x5a/0xd0
[  363.580209]  schedule_preempt_disabled+0x11/0x20
[  363.580211]  __mutex_lock.constprop.0+0x399/0x700
[  363.580213]  addrconf_verify_work+0xe/0x20
[  363.580215]  process_one_work+0x1c7/0x380
[  363.580218]  worker_thread+0x4d/0x380
[  363.580220]  ? rescuer_thread+0x3a0/0x3a0
[  363.580223]  kthread+0xda/0x100
[  363.580227]  ret_from_fork+0x1f/0x30
[  363.580230]  </TASK>
"""


def test_a_blocked_task_is_named_with_where_it_waits() -> None:
    assert blocked_tasks(_REPORT + _REPORT) == (
        "kworker/2:3 in addrconf_verify_work < process_one_work < worker_thread < kthread",
    )


def test_other_lines_of_a_console_are_no_blocked_tasks() -> None:
    assert blocked_tasks("[    1.0] Linux version 6.1.0\nlab: ready\n[  9.1] INFO: task cut off") == ()


def test_a_request_without_an_answer_names_the_blocked_tasks(tmp_path: Path) -> None:
    (tmp_path / "console").write_text(_REPORT, encoding="utf-8")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as silent:
        silent.bind(str(tmp_path / "control.sock"))
        silent.listen()
        with pytest.raises(LabError, match=r"did not answer mend within 0\.1 s; its kernel .*addrconf_verify_work"):
            request(tmp_path, {"op": "mend", "where": "b01"}, timeout_s=0.1)
