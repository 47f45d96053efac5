"""The process of all model nodes: a dropbear for each, and answers that come when a router's would.

`python -m benchmarks.model_node.server DIRECTORY` reads `nodes.json` there, starts the servers and prints `ready`. It
answers each line on its standard input with the processes and syncs of all nodes, and ends when that closes.

A login runs a forced command, a shell that reports its process id and waits: this process reads the command from the
shell's environment and standard input, computes the answer, writes it when it is due, and sends the exit status through
a pipe of the node's own. So a command costs this machine one small shell.

It has its own mount namespace, where /root holds only the benchmark's public key.
"""

from __future__ import annotations

import heapq
import json
import os
import selectors
import subprocess
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.model_node.chain import chain_sections
from benchmarks.model_node.node import (
    LOGIN_S,
    READER,
    Cost,
    Node,
    UnknownCommand,
    recorded_costs,
    recorded_sections,
    takes_input,
)
from meshlab import namespaces as ns

_READ_BYTES = 1 << 16


@dataclass(slots=True)
class _Command:
    """One command that is being read, computed or waited for."""

    node: Node
    process: int
    script: str
    stdin: int
    stdout: int
    is_login: bool
    given: bytearray = field(default_factory=bytearray)


class _Server:
    def __init__(self, directory: Path, costs: dict[str, Cost], sections: dict[str, tuple[str, str]]) -> None:
        self.directory = directory
        self.selector = selectors.DefaultSelector()
        self.due: list[tuple[float, int, Callable[[], None]]] = []
        self.number = 0
        now_s = time.monotonic()
        self.nodes: dict[str, Node] = {}
        self.pipes: dict[str, int] = {}
        self.in_work: set[str] = set()
        self.queued: dict[str, deque[int]] = defaultdict(deque)
        self.sessions: set[tuple[str, int]] = set()
        self.servers: list[subprocess.Popen[bytes]] = []
        for name, item in json.loads((directory / "nodes.json").read_text()).items():
            files = {path: content.encode() for path, content in item["files"].items()}
            own = chain_sections(sections, *item["chain"]) if item["chain"] else sections
            self.nodes[name] = Node(name, item["address"], files, item["version"], costs, own, now_s - 3600)
            self.pipes[name] = _fifo(directory / f"{name}.status")
            self.servers.append(self._dropbear(name, item["port"]))

    def _dropbear(self, name: str, port: int) -> subprocess.Popen[bytes]:
        relay = self.directory / "relay"
        command = ["dropbear", "-F", "-E", "-s", "-p", f"127.0.0.1:{port}", "-P", str(self.directory / f"{name}.pid")]
        command += ["-r", str(self.directory / f"{name}.key"), "-c", f"exec {relay} {name}"]
        log = (self.directory / "dropbear.log").open("ab")
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, preexec_fn=ns.die_with_parent
        )

    def serve(self) -> None:
        requests = _fifo(self.directory / "requests")
        self.selector.register(requests, selectors.EVENT_READ, lambda: self._take(requests))
        self.selector.register(0, selectors.EVENT_READ, self._control)
        print("ready", flush=True)
        while True:
            timeout = self.due[0][0] - time.monotonic() if self.due else None
            for key, _ in self.selector.select(timeout if timeout is None else max(0.0, timeout)):
                key.data()
            while self.due and self.due[0][0] <= time.monotonic():
                heapq.heappop(self.due)[2]()

    def _control(self) -> None:
        if os.read(0, _READ_BYTES):
            print(json.dumps({name: (node.processes, node.syncs) for name, node in self.nodes.items()}), flush=True)
            return
        for server in self.servers:
            server.terminate()
        sys.exit(0)

    def _take(self, requests: int) -> None:
        for line in os.read(requests, _READ_BYTES).decode().splitlines():
            name, process = line.split()
            self._open(self.nodes[name], int(process))

    def _open(self, node: Node, process: int) -> None:
        if node.name in self.in_work:
            # its neighbors may be queried for several nodes at once
            self.queued[node.name].append(process)
            return
        self.in_work.add(node.name)
        environment = Path(f"/proc/{process}/environ").read_bytes().split(b"\0")
        script = next((text[21:] for text in environment if text.startswith(b"SSH_ORIGINAL_COMMAND=")), b"").decode()
        session = (node.name, int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1]))
        stdin = os.open(f"/proc/{process}/fd/4", os.O_RDONLY | os.O_NONBLOCK)
        stdout = os.open(f"/proc/{process}/fd/5", os.O_WRONLY)
        command = _Command(node, process, script, stdin, stdout, session not in self.sessions)
        self.sessions.add(session)
        if takes_input(script):
            self.selector.register(stdin, selectors.EVENT_READ, lambda: self._read(command))
        else:
            # ansible closes the input of a command only when it has ended
            os.close(stdin)
            self._compute(command)

    def _read(self, command: _Command) -> None:
        data = os.read(command.stdin, _READ_BYTES)
        command.given += data
        if data:
            return
        self.selector.unregister(command.stdin)
        os.close(command.stdin)
        self._compute(command)

    def _compute(self, command: _Command) -> None:
        node, now_s = command.node, time.monotonic()
        began_s = max(now_s, node.busy_until_s) + (LOGIN_S if command.is_login else 0.0)
        script, stdin = _unframed(command.script, bytes(command.given))
        try:
            answer = node.answer(script, stdin, began_s)
        except UnknownCommand as error:
            print(f"{node.name}: unknown command: {error}", file=sys.stderr, flush=True)
            self._finish(command, b"", 127)
            return
        node.busy_until_s = began_s + answer.busy_s
        self.number += 1
        at_s = max(node.busy_until_s, answer.not_before_s)
        heapq.heappush(self.due, (at_s, self.number, lambda: self._finish(command, answer.output, answer.status)))

    def _finish(self, command: _Command, output: bytes, status: int) -> None:
        with open(command.stdout, "wb") as stdout:
            try:
                stdout.write(output)
                stdout.flush()
            except BrokenPipeError:
                # the client has gone
                pass
        self.in_work.discard(command.node.name)
        os.write(self.pipes[command.node.name], f"{status}\n".encode())
        if self.queued[command.node.name]:
            self._open(command.node, self.queued[command.node.name].popleft())


def _fifo(path: Path) -> int:
    os.mkfifo(path)
    return os.open(path, os.O_RDWR | os.O_NONBLOCK)


def _unframed(command: str, given: bytes) -> tuple[str, bytes]:
    """The script and its input: `meshctl.device.framing` sends a long script before its input, up to a mark."""
    if not command.startswith(READER):
        return command, given
    mark = command.partition('"$l" != ')[2].partition(" ")[0]
    script, _, rest = given.partition(f"\n{mark}\n".encode())
    return script.decode() + "\n", rest


def main() -> None:
    directory = Path(sys.argv[1])
    # before /root is another one: the repository may be there
    costs, sections = recorded_costs(), recorded_sections()
    if os.geteuid() != 0:
        ns.enter_user_namespace()
    ns.unshare(ns.CLONE_NEWNS)
    ns.make_private()
    if _is_user_namespace():
        ns.accept_setgroups()
    ns.bind(str(directory / "root"), "/root")
    ns.bind(str(directory / "passwd"), "/etc/passwd")
    _Server(directory, costs, sections).serve()


def _is_user_namespace() -> bool:
    return Path("/proc/self/setgroups").read_text().strip() == "deny"


if __name__ == "__main__":
    main()
