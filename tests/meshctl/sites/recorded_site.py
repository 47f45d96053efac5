"""A site whose nodes are recordings, all or all but its base: `plan` and `apply` of its worker, which is meshctl's own.

`python -m tests.meshctl.sites.recorded_site worker FLEET/SITE --nats URL` is `meshctl worker`, whose `plan` and `apply`
are this program's: they read the nodes' names and the desired power from the site's part of the inventory, keep each
node's power in a file, and print what a virtual node of one of several kinds printed (`recordings/`, made by
`record_kinds`), in the same order and with the same waits, some at a time. Some nodes never answer. With
VIRTUAL_VARIABLE set, the site's base is a virtual node, which meshctl's own `plan` and `apply` change at the same time.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

RECORDINGS = Path(__file__).with_name("recordings")
MODULE = "tests.meshctl.sites.recorded_site"
# How many nodes change at the same time, and how much faster than the recorded one.
PARALLEL = 8
SPEED_VARIABLE = "MESHCTL_RECORDED_SPEED"
VIRTUAL_VARIABLE = "MESHCTL_RECORDED_VIRTUAL_BASE"
NODE, MESH = "NODE", "MESH"
NO_ANSWER = "no answer within 10 s (a recorded node that is switched off)"
# of a hundred nodes: so many are switched off, and so many are of each kind that does not end `done`
_OFF, _RARE = 5, 3


@cache
def recordings() -> dict[str, dict[str, Any]]:
    """Kind -> its plan and events."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(RECORDINGS.glob("*.json"))}


def result_of(kind: str) -> str:
    return str(recordings()[kind]["events"][-1]["outcome"]["result"])


def kind_of(node: str) -> str:
    """The kind of a node, by its name; empty for one that is switched off."""
    if node.endswith("-base"):
        return "base"
    number = int(hashlib.sha256(node.encode()).hexdigest(), 16)
    percent, rest = number % 100, number // 100
    if percent < _OFF:
        return ""
    kinds = [kind for kind in recordings() if kind != "base"]
    rare = [kind for kind in kinds if result_of(kind) != "done"]
    if percent < _OFF + _RARE * len(rare):
        return rare[(percent - _OFF) // _RARE]
    usual = [kind for kind in kinds if kind not in rare]
    return usual[rest % len(usual)]


def expected_result(node: str) -> str:
    """How the first change of a node ends."""
    kind = kind_of(node)
    return result_of(kind) if kind else "unreachable"


def is_virtual(node: str) -> bool:
    return VIRTUAL_VARIABLE in os.environ and node.endswith("-base")


def power_file(state: Path, node: str) -> Path:
    return state / "recorded-nodes" / node


def changes_of(state: Path, node: str) -> list[str]:
    """The powers that a node was given, in order."""
    path = power_file(state, node)
    return path.read_text().split() if path.exists() else []


def _recorded(node: str, value: Any) -> Any:
    text = json.dumps(value)
    return json.loads(text.replace(NODE, node).replace(MESH, node.partition("-")[0]))


def _option(words: list[str], name: str) -> Path:
    return Path(words[words.index(name) + 1])


def _fleet_text(words: list[str]) -> str:
    return (_option(words, "-i") / "fleet.yaml").read_text()


def _desired_power(words: list[str]) -> str:
    found = re.search(r"max_drive_dbm['\"]?: ['\"]?(\d+)", _fleet_text(words))
    assert found is not None, "no max_drive_dbm in the site's part"
    return found[1]


def _state() -> Path:
    return Path(os.environ["XDG_STATE_HOME"])


def _real(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "meshctl", *words]
    return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)


def plan(words: list[str]) -> None:
    """`plan NODES... --out FILE ... -i INVENTORY`."""
    count = next(index for index, word in enumerate(words) if word.startswith("-"))
    nodes, options = words[:count], words[count:]
    out, desired = _option(words, "--out"), _desired_power(words)
    virtual = [node for node in nodes if is_virtual(node)]
    if virtual:
        done = _real("plan", *virtual, *options)
        if not out.exists():
            sys.exit(done.stderr or "no plan")
        document = json.loads(out.read_text())
    else:
        fleet = re.search(r"^['\"]?fleet['\"]?: ['\"]?(\w+)", _fleet_text(words), re.M)
        assert fleet is not None
        document = _EMPTY_PLAN | {"created_s": time.time(), "fleet": fleet[1], "entry": nodes[0], "entries": [nodes[0]]}
    made = [_planned(node, desired) for node in nodes if node not in virtual]
    changing = [each["node"] for each in made if each["verdict"] == "change"]
    stage = {"kind": "free", "nodes": changing, "reason": "interrupts nothing", "cuts_off": [], "mesh": ""}
    document["nodes"] = [*document["nodes"], *made]
    document["stages"] = [*document["stages"], *([stage] if changing else [])]
    out.write_text(json.dumps(document, indent=1) + "\n")


_EMPTY_PLAN: dict[str, Any] = {
    "format": "meshctl-plan",
    "version": 3,
    "inventory": "",
    "salt": "617dfd87870c37716f3bc268a44da7fa",
    "with_firmware": True,
    "refusal": "",
    "refusal_hint": "",
    "notes": [],
    "ways": [],
    "pace": "",
    "stages": [],
    "nodes": [],
}


def _planned(node: str, desired: str) -> dict[str, Any]:
    kind = kind_of(node)
    made: dict[str, Any] = _recorded(node, recordings()[kind or "base"]["plan"])
    kept = changes_of(_state(), node)
    if not kind:
        return made | {"verdict": "away", "reason": NO_ANSWER, "files": [], "effects": []}
    if kept and kept[-1] == desired:
        return made | {"verdict": "same", "files": [], "effects": []}
    return made


def apply(words: list[str]) -> None:
    """`apply PLAN [--dry-run] --json -i INVENTORY`."""
    document = json.loads(Path(words[0]).read_text())
    recorded = [node for node in document["nodes"] if not is_virtual(node["node"])]
    virtual = [node for node in document["nodes"] if is_virtual(node["node"])]
    part = Path(words[0]).with_name("virtual-plan.json")
    if virtual:
        names = {node["node"] for node in virtual}
        stages = [stage for stage in document["stages"] if names & set(stage["nodes"])]
        part.write_text(json.dumps(document | {"nodes": virtual, "stages": stages}))
    if "--dry-run" in words:
        if virtual:
            done = _real("apply", str(part), *words[1:])
            if not done.stdout.strip():
                sys.exit(done.stderr or "no plan")
            applies = json.loads(done.stdout)
            stages = [stage for stage in document["stages"] if not names & set(stage["nodes"])]
            document = applies | {
                "nodes": [*applies["nodes"], *recorded],
                "stages": [*applies["stages"], *stages],
            }
        sys.stdout.write(json.dumps(document, indent=1) + "\n")
        return
    outcomes: list[dict[str, Any]] = []
    changing = threading.Thread(target=_change, args=([str(part), *words[1:]], outcomes))
    if virtual:
        changing.start()
    outcomes_recorded = _play_all(recorded, _desired_power(words))
    if virtual:
        changing.join()
    ended = {"event": "ended", "run": 1, "totals": "", "outcomes": [*outcomes, *outcomes_recorded]}
    _write(ended)


_writing = threading.Lock()


def _write(event: dict[str, Any]) -> None:
    with _writing:
        sys.stdout.write(json.dumps(event) + "\n")
        sys.stdout.flush()


def _change(words: list[str], outcomes: list[dict[str, Any]]) -> None:
    """meshctl's own `apply`; its events are written as they come, its outcomes kept for the last event."""
    command = [sys.executable, "-m", "meshctl", "apply", *words]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            event = json.loads(line)
            if event["event"] == "ended":
                outcomes += event["outcomes"]
            else:
                _write(event)


def _play_all(nodes: list[dict[str, Any]], desired: str) -> list[dict[str, Any]]:
    speed = float(os.environ.get(SPEED_VARIABLE, "1"))
    changing = [node["node"] for node in nodes if node["verdict"] == "change"]
    outcomes = []
    for node in nodes:
        outcomes.append(_outcome(node))
        if node["verdict"] != "change":
            _write({"event": "finished", "node": node["node"], "at_s": time.time(), "outcome": outcomes[-1]})
    for first in range(0, len(changing), PARALLEL):
        for event in _played(changing[first : first + PARALLEL], desired, speed):
            _write(event)
    return outcomes


def _outcome(node: dict[str, Any]) -> dict[str, Any]:
    name = node["node"]
    if node["verdict"] in ("same", "away"):
        result = {"same": "unchanged", "away": "unreachable"}[node["verdict"]]
        return {"node": name, "result": result, "reason": node["reason"], "hint": "", "duration_s": 0.0, "facts": {}}
    found: dict[str, Any] = _recorded(name, recordings()[kind_of(name)]["events"][-1]["outcome"])
    return found


def _played(nodes: list[str], desired: str, speed: float) -> Iterator[dict[str, Any]]:
    """The recorded events of these nodes, which begin at the same time."""
    waiting = []
    for node in nodes:
        events = recordings()[kind_of(node)]["events"]
        waiting += [(event["at_s"] - events[0]["at_s"], node, event) for event in events]
    before_s = 0.0
    for at_s, node, event in sorted(waiting, key=lambda each: each[0]):
        time.sleep((at_s - before_s) / speed)
        before_s = at_s
        if event["event"] == "finished" and event["outcome"]["result"] == "done":
            path = power_file(_state(), node)
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a") as file:
                file.write(f"{desired}\n")
        yield _recorded(node, event) | {"at_s": time.time()}


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
        case "worker":
            worker(rest)
        case _:
            sys.exit(f"a recorded site has no {command}")
