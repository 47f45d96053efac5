"""A computer of a live team that still has the legacy program: nothing it sends or gets is authenticated.

`python -m tests.udp_mesh.daemon.live.legacy NAME ADDRESS BROADCAST` is its program: a JSON object per line, messages to
send on standard input, and what was received on standard output. It ends with its standard input, between two
datagrams.
"""

from __future__ import annotations

import base64
import json
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import NamedTuple

from tests.udp_mesh.core.legacy_node import TO_ALL, TYPE, SocketLegacyNode
from tests.udp_mesh.daemon.live.ether import Ether
from tests.udp_mesh.daemon.live.programs import Broken, Sent, key_of, payload_of
from tests.udp_mesh.daemon.live.radio import Radio
from tests.udp_mesh.daemon.processes import poll
from udp_mesh.wire.legacy import PriorityMeshData

NAME = "old"
TOPICS = ("status", "map")
"""What it sends; the names are known to the others as well."""


class Taken(NamedTuple):
    """A message that its programs got."""

    source: str
    topic: str
    key: bytes


class LegacyRobot:
    """A namespace, an interface and the program."""

    def __init__(self, place: int, ether: Ether, folder: Path) -> None:
        self.runs = 0
        self.restarted_at: list[float] = []
        self.log = folder / f"{NAME}.log"
        self.process: subprocess.Popen[str] | None = None
        self._taken: deque[str] = deque()
        # Ends with this process, whose end of the pipe is then closed.
        self.holder = subprocess.Popen(["unshare", "--net", "cat"], stdin=subprocess.PIPE)
        self.radio = Radio(NAME, place, 0, ether, ipv6=False)

    @property
    def neighbour(self) -> str:
        """Of the others' configuration."""
        host = self.radio.address.partition("/")[0]
        return f'[[neighbours]]\naddress = "{host}"\nname = "{NAME}"\nlegacy = true\n'

    def start(self) -> None:
        namespace = f"/proc/{self.holder.pid}/ns/net"
        poll(lambda: Path(namespace).readlink() != Path("/proc/self/ns/net").readlink(), "a network namespace")
        if not self.runs:
            self.radio.attach(self.holder.pid, self._ip)
        self.runs += 1
        address = self.radio.address.partition("/")[0]
        broadcast = ".".join(address.split(".")[:2]) + ".255.255"
        command = [
            "nsenter",
            "-t",
            str(self.holder.pid),
            "-n",
            sys.executable,
            "-m",
            __name__,
            NAME,
            address,
            broadcast,
        ]
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )
        threading.Thread(target=self._read, args=(self.process,), daemon=True).start()

    def _ip(self, words: str) -> None:
        subprocess.run(["nsenter", "-t", str(self.holder.pid), "-n", "ip", *words.split()], check=True)

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        self._taken.extend(process.stdout)

    def send(self, sent: Sent) -> None:
        """To one robot, or to all."""
        assert self.process is not None
        assert self.process.stdin is not None
        data = base64.b64encode(payload_of(sent.key, sent.size)).decode()
        self.process.stdin.write(json.dumps({"to": sent.to or TO_ALL, "topic": sent.topic, "data": data}) + "\n")
        self.process.stdin.flush()

    def poll(self) -> list[Taken]:
        """What its programs got since the last call. Raises Broken if the program ended by itself."""
        if self.process is not None and (code := self.process.poll()) is not None:
            raise Broken(f"the legacy program ended by itself with {code}: {self.log.read_text()[-3000:]}")
        found = []
        while self._taken:
            line = json.loads(self._taken.popleft())
            found.append(Taken(line["source"], line["topic"], key_of(base64.b64decode(line["data"]))))
        return found

    def restart(self) -> None:
        """Its next run knows nothing of this one, nor do the others: no boot id is on the wire."""
        self.end()
        self.restarted_at.append(time.monotonic())
        self.start()

    def end(self) -> None:
        if self.process is not None and self.process.stdin is not None:
            self.process.stdin.close()
            self.process.wait(60)
        self.process = None

    def close(self) -> None:
        self.end()
        self.radio.close()
        self.holder.kill()
        self.holder.wait()


def main() -> None:
    name, address, broadcast = sys.argv[1:]

    def on_message(source: str, message: PriorityMeshData) -> None:
        data = base64.b64encode(message.data).decode()
        sys.stdout.write(json.dumps({"source": source, "topic": message.topic, "data": data}) + "\n")
        sys.stdout.flush()

    node = SocketLegacyNode(name, address, broadcast, on_message)

    def read() -> None:
        for line in sys.stdin:
            wanted = json.loads(line)
            data = base64.b64decode(wanted["data"])
            node.outgoing.put(PriorityMeshData(wanted["to"], TYPE, 5, wanted["topic"], data))

    reader = threading.Thread(target=read)
    reader.start()
    while reader.is_alive():
        node.turn()


if __name__ == "__main__":
    main()
