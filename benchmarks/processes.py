"""Which processes one change starts on a node, by who starts them: `python -m benchmarks.processes [--results FILE]`.

A virtual node is provisioned once while the kernel's process connector (CONFIG_PROC_EVENTS, root only) reports every
fork and exec. Each process counts for the part of meshctl that started it, as one of three kinds:

- `meshctl`: started by meshctl's own scripts, an OpenWrt tool that they call included. On a router it is the same.
- `in tools`: started inside such a tool. The lab's stand-ins for ubus, uci, iw, batctl and nft are shell scripts; on a
  router those are programs that start nothing. Init scripts and reload_config start processes there, too.
- `OpenWrt`: started by procd and netifd because the configuration has changed.

A process that has ended before its command line was read counts as what its parent is: on a busy machine only the sum
of the first two is exact.
"""

from __future__ import annotations

import argparse
import os
import re
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.model_node.counting import counted
from benchmarks.page import append_result
from meshlab.fleet import VirtualNode
from tests.meshctl.proof.rig import Rig

RESULTS = Path(__file__).with_name("results") / "processes.jsonl"
OURS, IN_TOOLS, OPENWRT = "meshctl", "in tools", "OpenWrt"
TOOLS = ("ubus", "uci", "iw", "batctl", "nft", "fw4", "fw3", "reload_config", "wifi", "sync", "date")
WINDOW_S = 120
QUIET_S = 15
# linux/connector.h, linux/cn_proc.h
_CN_IDX_PROC, _PROC_CN_MCAST_LISTEN = 1, 1
_FORK, _EXEC = 1, 2
_NETLINK_CONNECTOR = 11
_RECEIVE_BUFFER_BYTES = 8 << 20
_PARTS = (
    ("reload", re.compile(r"^sh -c PACKAGES=")),
    ("switch: change", re.compile(r"meshctl-deadman change")),
    ("switch: timers", re.compile(r"meshctl-deadman (watch|guard|expire)")),
    ("switch: confirm", re.compile(r"meshctl-deadman (confirm|status|abort)")),
    ("station watch", re.compile(r"watch_stale|flush_stale")),
)


@dataclass(slots=True)
class Started:
    """A process that was started while the kernel reported; `parent` is None for the child of one that ran before."""

    root: int
    parent: Started | None
    command_lines: list[list[str]] = field(default_factory=list)


@dataclass(slots=True)
class Tree:
    """All processes that were started, oldest first. Ids are used again within minutes, so `running` is by time."""

    started: list[Started] = field(default_factory=list)
    running: dict[int, Started] = field(default_factory=dict)

    def follow(self, connector: socket.socket) -> None:
        """Read the kernel's reports until the socket is closed."""
        while True:
            try:
                message = connector.recv(4096)
            except OSError:
                return
            # struct nlmsghdr, struct cn_msg, then what, cpu, timestamp_ns and the ids of struct proc_event
            what, _, _, *ids = struct.unpack_from("=IIQIIII", message, 36)
            if what == _FORK and ids[2] == ids[3]:
                parent = self.running.get(ids[1])
                child = Started(ids[1] if parent is None else parent.root, parent)
                self.running[ids[3]] = child
                self.started.append(child)
            elif what == _EXEC and ids[1] in self.running:
                self.running[ids[1]].command_lines.append(_command_line(ids[1]))


def _command_line(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")[:-1]
    except OSError:
        return []


def kind_of(process: Started, login_servers: frozenset[int]) -> tuple[str, str]:
    """The part of meshctl, and the kind."""
    if process.root not in login_servers:
        return "", OPENWRT
    chain = [process]
    while chain[-1].parent is not None:
        chain.append(chain[-1].parent)
    part, kind = "login and observation", OURS
    for ancestor in reversed(chain):
        for words in filter(None, ancestor.command_lines):
            part = next((name for name, pattern in _PARTS if pattern.search(" ".join(words))), part)
            if ancestor is not process and _is_tool(words):
                kind = IN_TOOLS
    return part, kind


def _is_tool(words: Sequence[str]) -> bool:
    """Whether it is one of OpenWrt's tools; a script has its interpreter first."""
    *_, program = words[:2] if Path(words[0]).name in ("sh", "ash") else words[:1]
    return Path(program).name in TOOLS or program.startswith("/etc/init.d/")


def listening() -> socket.socket:
    """A socket on which the kernel reports the forks and execs of the whole machine."""
    connector = socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, _NETLINK_CONNECTOR)
    connector.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    connector.bind((os.getpid(), _CN_IDX_PROC))
    asked = struct.pack("=IIIIHHI", _CN_IDX_PROC, 1, 0, 0, 4, 0, _PROC_CN_MCAST_LISTEN)
    connector.send(struct.pack("=IHHII", 16 + len(asked), 3, 0, 0, os.getpid()) + asked)
    return connector


def processes_of(node: VirtualNode, fleet: Path) -> dict[int, str]:
    """Host process id -> command line, of every process of the node: those whose host name is its name."""
    found = {}
    for entry in Path("/proc").iterdir():
        try:
            if not entry.name.isdigit() or str(fleet) not in (entry / "mountinfo").read_text():
                continue
            words = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        named = subprocess.run(["nsenter", "-t", entry.name, "-u", "uname", "-n"], capture_output=True, text=True)
        if named.stdout.strip() == node.name:
            found[int(entry.name)] = words
    return found


def measure() -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="processes-") as text, Rig(Path(text), 1, window_s=WINDOW_S) as rig:
        taken = rig.take_in("a")
        if taken.code:
            raise RuntimeError(f"cannot bootstrap the node:\n{taken.out}{taken.err}")
        time.sleep(QUIET_S)
        node = rig.fleet.node("n001")
        residents = processes_of(node, rig.fleet.directory)
        # the one that listens, and one for each connection that meshctl keeps
        servers = frozenset(pid for pid, words in residents.items() if words.startswith("/usr/sbin/dropbear"))
        tree, connector = Tree(), listening()
        threading.Thread(target=tree.follow, args=(connector,), daemon=True).start()
        before = counted(node)
        ended = rig.meshctl("provision", "b", "n001", "--yes", "--json")
        time.sleep(QUIET_S)
        counts = Counter(kind_of(each, servers) for each in tuple(tree.started) if each.root in residents)
        after = counted(node)
        connector.close()
    if ended.code:
        raise RuntimeError(f"the change failed:\n{ended.out}{ended.err}")
    return {
        "counts": [[part, kind, count] for (part, kind), count in sorted(counts.items())],
        "processes": after.processes - before.processes,
        "syncs": after.syncs - before.syncs,
    }


def table(result: Mapping[str, Any]) -> str:
    counts = {(part, kind): count for part, kind, count in result["counts"]}
    lines = ["| started by | meshctl | in the tools it calls | both |", "| --- | ---: | ---: | ---: |"]
    parts = sorted({part for part, kind in counts if kind != OPENWRT})
    rows = [(part, counts.get((part, OURS), 0), counts.get((part, IN_TOOLS), 0)) for part in parts]
    rows.append(("together", sum(row[1] for row in rows), sum(row[2] for row in rows)))
    lines += [f"| {part} | {ours} | {tools} | {ours + tools} |" for part, ours, tools in rows]
    rest = counts.get(("", OPENWRT), 0)
    return "\n".join([*lines, "", f"OpenWrt's own reload started {rest} more; {result['syncs']} syncs."])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.processes", description=__doc__)
    parser.add_argument("--results", type=Path, default=RESULTS)
    chosen = parser.parse_args(arguments)
    if os.geteuid() != 0:
        parser.error("needs root: only root hears of all processes")
    result = measure()
    append_result(chosen.results, result)
    print(table(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
