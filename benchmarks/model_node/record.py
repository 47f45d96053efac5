"""Record what a virtual node answers and needs: `python -m benchmarks.model_node.record`.

It provisions one virtual node, command by command as meshctl does and as ansible does, and writes observation.txt and
costs.json: for each kind of command, the processes that it started (the node's own process ids, which the kernel gives
out in sequence) and how often it called sync.
"""

from __future__ import annotations

import json
import re
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from benchmarks.model_node.counting import counting
from benchmarks.model_node.node import RECORDED_COSTS, RECORDED_OBSERVATION, Cost, kind_of
from benchmarks.provisioning import script
from meshctl.apply.change_set import new_change_id, new_nonce, reload_script
from meshctl.apply.stale_stations import StationEntry, flush_script, watch_script
from meshctl.device import deadman
from meshctl.device.connection import Completed, Connection, Credentials, Endpoint
from meshctl.device.deadman import Change, NewFile, Payload
from meshctl.device.observe import observation_script, observe
from meshctl.device.openwrt import measure_uptime
from meshctl.device.parse.sections import split_sections
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.trust import AcceptAnyKey
from meshlab.fleet import VirtualNode
from tests.meshctl.proof.rig import Rig

RELOAD_LIMIT_S = 10
# long enough to abort the change before it starts
LATER_S = 60.0
OWNER = "recorder@bench:1:1"


class CountingConnection(Connection):
    """Counts each command of a connection."""

    def __init__(self, connection: SshConnection, node: VirtualNode, costs: dict[str, Cost]) -> None:
        self._connection, self._node, self._costs = connection, node, costs

    @property
    def endpoint(self) -> Endpoint:
        return self._connection.endpoint

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        with counting(self._node, kind_of(script), self._costs):
            return self._connection.run(script, stdin=stdin, timeout_s=timeout_s)

    def close(self) -> None:
        self._connection.close()


def connected(rig: Rig, name: str) -> SshConnection:
    return connect(
        rig.fleet.endpoint(str(rig.fleet.node(name).address), identity=name),
        credentials=Credentials(key_files=(rig.directory / "key",), use_agent=False),
        trust=AcceptAnyKey(),
    )


def change_of(rig: Rig, name: str) -> Change:
    """The change that takes a node from configuration `a` to `b`."""
    before, after = (rig.rendered(variant, name, "1.0") for variant in ("a", "b"))
    files = {f"/{path}": NewFile(content) for path, content in after.items() if content != before[path]}
    return Change(new_change_id(), files, reload_script({path[1:] for path in files}, ()))


def meshctl_change(rig: Rig, name: str, costs: dict[str, Cost]) -> str:
    """One change as meshctl makes it; returns an observation made before, with the nonce NONCE."""
    node, change, nonce = rig.fleet.node(name), change_of(rig, name), new_nonce()
    with connected(rig, name) as opened:
        connection = CountingConnection(opened, node, costs)
        observation = plain_text(connection.run(observation_script("NONCE")).stdout_bytes)
        deadman.change(connection, OWNER, Payload.of(change), nonce=nonce, window_s=90, ttl_s=120, await_reload_s=0)
        with counting(node, "reload", costs):
            time.sleep(RELOAD_LIMIT_S)
    with connected(rig, name) as opened:
        connection = CountingConnection(opened, node, costs)
        deadman.status(connection)
        deadman.confirm(connection, change.change_id, nonce=nonce, owner=OWNER)
    return observation


def plain_text(output: bytes) -> str:
    """An observation's sections, not compressed."""
    sections = split_sections(output, "NONCE")
    return "".join(
        f"NONCE begin {name}\n{section.text}\nNONCE end {section.status}\n" for name, section in sections.items()
    )


def scheduled_change(rig: Rig, name: str, costs: dict[str, Cost]) -> None:
    """One change as meshctl makes it on all nodes at one moment, and what it asks of a neighbor."""
    node, change, nonce = rig.fleet.node(name), change_of(rig, name), new_nonce()
    with connected(rig, name) as opened:
        connection = CountingConnection(opened, node, costs)
        heard = observe(opened).stations or ()
        entries = [StationEntry(name, station.ifname, station.mac) for station in heard]
        deadman.lock(connection, OWNER, ttl_s=120)
        deadman.stage(connection, OWNER, change)
        deadman.arm(connection, OWNER, change.change_id, nonce=nonce, window_s=90)
        connection.run(watch_script("base", entries, for_s=5))
        measure_uptime(connection, samples=1)
        connection.run(flush_script(entries, older_than_s=0))
        deadman.apply(connection, OWNER, change.change_id, in_s=LATER_S)
        deadman.abort(opened, OWNER, change.change_id)
        deadman.unlock(connection, OWNER)


def ansible_change(rig: Rig, name: str, costs: dict[str, Cost]) -> None:
    """One change as the playbook of benchmarks.provisioning makes it."""
    node = rig.fleet.node(name)
    place = "/root/.ansible/tmp/ansible-tmp-1.5-1-1"
    pushed = script(rig.rendered("a", name, "1.0")).encode()
    with connected(rig, name) as opened:
        connection = CountingConnection(opened, node, costs)
        connection.run("cat /etc/openwrt_release")
        connection.run("/bin/sh -c 'echo ~ && sleep 0'")
        connection.run(
            f'/bin/sh -c \'( umask 77 && mkdir -p "` echo /root/.ansible/tmp `"&& mkdir "` echo {place} `" )\''
        )
        connection.run(f"/bin/sh -c 'dd of={place}/{name}.sh bs=65536 && sleep 0'", stdin=pushed)
        connection.run(f"/bin/sh -c 'chmod u+rwx {place}/ {place}/{name}.sh && sleep 0'")
        connection.run(f"/bin/sh -c ' {place}/{name}.sh && sleep 0'")
        connection.run(f"/bin/sh -c 'rm -f -r {place}/ > /dev/null 2>&1 && sleep 0'")
        with counting(node, "ansible reload", costs):
            time.sleep(RELOAD_LIMIT_S)


def main() -> None:
    costs: dict[str, Cost] = {}
    with tempfile.TemporaryDirectory(prefix="model-node-") as directory, Rig(Path(directory), 1, window_s=90) as rig:
        taken = rig.take_in("a")
        if taken.code:
            raise RuntimeError(f"cannot bootstrap the node:\n{taken.out}{taken.err}")
        time.sleep(RELOAD_LIMIT_S)
        observation = meshctl_change(rig, "n001", costs)
        ansible_change(rig, "n001", costs)
        scheduled_change(rig, "n001", costs)
    RECORDED_OBSERVATION.write_text(without_neighbors(observation))
    RECORDED_COSTS.write_text(
        json.dumps({kind: [c.processes, c.syncs] for kind, c in sorted(costs.items())}, indent=1) + "\n"
    )
    for kind, cost in costs.items():
        print(f"{kind:20} {cost.processes:5} processes {cost.syncs:3} syncs")


def without_neighbors(observation: str) -> str:
    """A node on the bench hears no other."""
    for section in ("batctl.neighbors_json bat0", "batctl.originators_json bat0", "iw.stations mesh0"):
        empty = "[]\n" if section.startswith("batctl") else ""
        pattern = rf"(NONCE begin {re.escape(section)}\n)(?:.*\n)*?(\nNONCE end)"
        observation = re.sub(pattern, rf"\g<1>{empty}\g<2>", observation)
    return observation


if __name__ == "__main__":
    main()
