"""`python -m tests.meshctl.proof.operators DIRECTORY`: two operators, and a shared journal that dies midway.

Runs in a network namespace of its own, as `wires` does, since the journal of a fleet that meshctl knows to be virtual
is not shared. Alice changes one radio after the other, Bob wants the second one; then the database dies, and comes back
when Alice's run is over. Prints what both saw as JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.meshctl.fleet.postgresql_server import Server, running
from tests.meshctl.proof.rig import COMMAND_LIMIT_S, Ended, Rig, run
from tests.meshctl.proof.wires import WIRES, ip, plug_in, route


@dataclass(frozen=True, slots=True)
class Operator:
    """A person with a computer of their own."""

    name: str
    rig: Rig
    url: str

    @property
    def environ(self) -> dict[str, str]:
        return {
            **self.rig.environ,
            "XDG_STATE_HOME": str(self.rig.directory / self.name),
            "MESHCTL_STORE": self.url,
            "LOGNAME": self.name,
        }

    def start(self, *words: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "meshctl", *words],
            env=self.environ,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def meshctl(self, *words: str) -> Ended:
        return run(words, self.environ)

    def runs(self) -> list[dict[str, object]]:
        found: list[dict[str, object]] = json.loads(self.meshctl("history", "--json").out)
        return found


def main() -> int:
    ip("link set lo up")
    with running() as server, Rig(Path(sys.argv[1]), 2, parallel=1, knows_lab=False) as rig:
        rig.wait_all_up()
        plug_in(rig)
        url = server.new_database()
        alice, bob = Operator("alice", rig, url), Operator("bob", rig, url)
        wires = [word for wire in WIRES.values() for word in ("--interface", wire)]
        first = alice.meshctl("bootstrap", *WIRES, *_fleet(rig, "a"), *wires, "--yes", "--json")
        route()
        report = _two_at_once(alice, bob, server, rig)
        report |= {"bootstrap": first.results, "bootstrap_error": first.err}
    sys.stdout.write(json.dumps(report))
    return 0


def _two_at_once(alice: Operator, bob: Operator, server: Server, rig: Rig) -> dict[str, object]:
    wanted = (*_fleet(rig, "b"), "--yes", "--json")
    with alice.start("provision", *WIRES, *wanted) as process:
        assert process.stdout is not None
        said = []
        for line in process.stdout:
            said.append(line)
            if json.loads(line).get("event") == "step":
                break
        refused = bob.meshctl("provision", "n002", *wanted)
        server.stop()
        out, err = process.communicate(timeout=COMMAND_LIMIT_S)
    ended = Ended(process.returncode, "".join(said) + out, err)
    server.start()
    before = bob.runs()
    merged = alice.runs()
    return {
        "results": ended.results,
        "notice": ended.err,
        "refused": (refused.code, refused.err),
        "before": before,
        "merged": merged,
        "after": bob.runs(),
        "check": bob.meshctl("provision", *WIRES, *_fleet(rig, "b"), "--check").code,
    }


def _fleet(rig: Rig, variant: str) -> Sequence[str]:
    return ("-i", str(rig.inventory(variant)), "--key", str(rig.directory / "key"))


if __name__ == "__main__":
    sys.exit(main())
