"""A site whose nodes are recordings: the commands `plan` and `apply` of its worker, which is meshctl's own.

`python -m tests.meshctl.sites.recorded_site worker FLEET/SITE --nats URL` is `meshctl worker`, whose `plan` and `apply`
are this program's: they read the nodes' names and the desired power from the site's part of the inventory, keep each
node's power in a file, and print what one virtual node printed (`recordings/change.json`), in the same order and with
the same waits, some at a time. Some nodes never answer. `record RUN_DIRECTORY` makes the recording from a run at a site
of virtual nodes.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

RECORDING = Path(__file__).with_name("recordings") / "change.json"
MODULE = "tests.meshctl.sites.recorded_site"
# How many nodes change at the same time, and how much faster than the recorded one.
PARALLEL = 8
SPEED_VARIABLE = "MESHCTL_RECORDED_SPEED"
_NODE, _MESH = "NODE", "MESH"
NO_ANSWER = "no answer within 10 s (a recorded node that is switched off)"


def answers(node: str) -> bool:
    """Whether a node is switched on: about one of twenty is not."""
    return int(hashlib.sha256(node.encode()).hexdigest(), 16) % 20 != 0


def power_file(state: Path, node: str) -> Path:
    return state / "recorded-nodes" / node


def changes_of(state: Path, node: str) -> list[str]:
    """The powers that a node was given, in order."""
    path = power_file(state, node)
    return path.read_text().split() if path.exists() else []


def _recorded(node: str, mesh: str, value: Any) -> Any:
    text = json.dumps(value)
    return json.loads(text.replace(_NODE, node).replace(_MESH, mesh))


def _option(words: list[str], name: str) -> Path:
    return Path(words[words.index(name) + 1])


def _desired_power(inventory: Path) -> str:
    found = re.search(r"max_drive_dbm['\"]?: ['\"]?(\d+)", (inventory / "fleet.yaml").read_text())
    assert found is not None, f"no max_drive_dbm in {inventory}"
    return found[1]


def _state() -> Path:
    return Path(os.environ["XDG_STATE_HOME"])


def plan(words: list[str]) -> None:
    """`plan NODES... --out FILE ... -i INVENTORY`."""
    nodes = words[: next(index for index, word in enumerate(words) if word.startswith("-"))]
    inventory = _option(words, "-i")
    desired = _desired_power(inventory)
    recording = json.loads(RECORDING.read_text())
    document, template = recording["plan"], recording["plan"]["nodes"][0]
    made = [_planned(node, desired, template) for node in nodes]
    changing = [each["node"] for each in made if each["verdict"] == "change"]
    stage = {"kind": "free", "nodes": changing, "reason": "interrupts nothing", "cuts_off": [], "mesh": ""}
    document |= {"nodes": made, "stages": [stage] if changing else [], "created_s": time.time(), "ways": []}
    fleet = re.search(r"^['\"]?fleet['\"]?: ['\"]?(\w+)", (inventory / "fleet.yaml").read_text(), re.M)
    assert fleet is not None
    document |= {"fleet": fleet[1], "entry": nodes[0], "entries": [nodes[0]]}
    _option(words, "--out").write_text(json.dumps(document, indent=1) + "\n")


def _planned(node: str, desired: str, template: dict[str, Any]) -> dict[str, Any]:
    made: dict[str, Any] = _recorded(node, node.partition("-")[0], template)
    kept = changes_of(_state(), node)
    if not answers(node):
        return made | {"verdict": "away", "reason": NO_ANSWER, "files": [], "effects": []}
    if kept and kept[-1] == desired:
        return made | {"verdict": "same", "files": [], "effects": []}
    return made


def apply(words: list[str]) -> None:
    """`apply PLAN [--dry-run] --json -i INVENTORY`."""
    document = json.loads(Path(words[0]).read_text())
    if "--dry-run" in words:
        sys.stdout.write(json.dumps(document, indent=1) + "\n")
        return
    desired = _desired_power(_option(words, "-i"))
    speed = float(os.environ.get(SPEED_VARIABLE, "1"))
    changing = [node["node"] for node in document["nodes"] if node["verdict"] == "change"]
    outcomes = {node["node"]: _outcome(node) for node in document["nodes"]}
    for first in range(0, len(changing), PARALLEL):
        for event in _played(changing[first : first + PARALLEL], desired, speed):
            sys.stdout.write(json.dumps(event) + "\n")
            sys.stdout.flush()
    ended = {"event": "ended", "run": 1, "totals": "", "outcomes": list(outcomes.values())}
    sys.stdout.write(json.dumps(ended) + "\n")


def _outcome(node: dict[str, Any]) -> dict[str, Any]:
    results = {"change": "done", "same": "unchanged", "away": "unreachable"}
    found = {"node": node["node"], "result": results[node["verdict"]], "reason": node["reason"], "hint": ""}
    return {**found, "duration_s": 0.0, "facts": {}}


def _played(nodes: list[str], desired: str, speed: float) -> Iterator[dict[str, Any]]:
    """The recorded events for these nodes at the same time."""
    events = json.loads(RECORDING.read_text())["events"]
    before_s = events[0]["at_s"]
    for event in events:
        time.sleep((event["at_s"] - before_s) / speed)
        before_s = event["at_s"]
        for node in nodes:
            if event["event"] == "finished":
                path = power_file(_state(), node)
                path.parent.mkdir(parents=True, exist_ok=True)
                with path.open("a") as file:
                    file.write(f"{desired}\n")
            yield _recorded(node, node.partition("-")[0], event) | {"at_s": time.time()}


def record(run: Path) -> None:
    """Make the recording from the first node of a real site's run."""
    document = json.loads((run / "plan.json").read_text())
    events = [json.loads(line) for line in (run / "events").read_text().splitlines()]
    node, mesh = events[0]["node"], document["nodes"][0]["meshes"][0]
    its = [event for event in events if event.get("node") == node]
    document["nodes"] = [each for each in document["nodes"] if each["node"] == node]
    document |= {"inventory": "", "stages": [], "ways": [], "notes": [], "entry": _NODE, "entries": [_NODE]}
    text = json.dumps({"plan": document, "events": its}, indent=1)
    RECORDING.parent.mkdir(exist_ok=True)
    text = (
        text.replace(f'"{node}"', f'"{_NODE}"')
        .replace(f"node={node}", f"node={_NODE}")
        .replace(f'"{mesh}"', f'"{_MESH}"')
    )
    RECORDING.write_text(text + "\n")


def worker(words: list[str]) -> None:
    """`meshctl worker`, with the commands of this program."""
    from meshctl.cli.main import main
    from meshctl.sites import runner

    runner.meshctl_command = lambda *others: [sys.executable, "-m", MODULE, *others]
    sys.argv = ["meshctl", "worker", *words]
    main()


if __name__ == "__main__":
    command, rest = sys.argv[1], sys.argv[2:]
    match command:
        case "plan":
            plan(rest)
        case "apply":
            apply(rest)
        case "record":
            record(Path(rest[0]))
        case "worker":
            worker(rest)
        case _:
            sys.exit(f"a recorded site has no {command}")
