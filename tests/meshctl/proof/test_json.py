"""Scripts read what `--json` prints: no key that was ever there disappears.

`json_keys.json` lists the keys by command, as paths (`nodes[].name`; `*` for a name, `[]` for an element, `<started>`
for an event). `python -m tests.meshctl.proof.test_json FILE` records them from a fleet that it starts.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.meshctl.proof.rig import Ended, Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("fleet")]

RECORDED = Path(__file__).parent / "json_keys.json"
# keys that are names of this fleet, MAC addresses, paths or file names, not words of the format
_NAME = re.compile(r"base|n\d{3}|proof|main|box|radio\d|[0-9a-f]{2}(:[0-9a-f]{2}){5}|.*/.*|MC\d+|\d+(\.\d+)*|.*\.yaml")


def paths(value: Any, prefix: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            name = f"{prefix}.{'*' if _NAME.fullmatch(key) else key}".lstrip(".")
            yield name
            yield from paths(inner, name)
    elif isinstance(value, list):
        for inner in value:
            yield from paths(inner, f"{prefix}[]")


def keys(ended: Ended) -> list[str]:
    """The paths in one document, or in the lines of a stream of events, each under its event's name."""
    try:
        return sorted(set(paths(json.loads(ended.out))))
    except ValueError:
        return sorted({path for event in ended.events for path in paths({f"<{event['event']}>": event})})


def documents(rig: Rig) -> dict[str, list[str]]:
    """The keys of every command's document; the fleet runs the other inventory afterwards."""
    old, new = rig.flip()
    found = {
        "lint": rig.meshctl("lint", "", str(rig.inventory(old)), "--json"),
        "inventory list": rig.meshctl("inventory", "", "list", "-i", str(rig.inventory(old)), "--json"),
        "inventory show": rig.meshctl("inventory", "", "show", "n001", "-i", str(rig.inventory(old)), "--json"),
        "render": rig.meshctl("render", "", "n001", "-i", str(rig.inventory(old)), "--json"),
        "diff": rig.meshctl("diff", "", str(rig.inventory(old)), str(rig.inventory(new)), "--json"),
        "plan": rig.meshctl("plan", new, "--json"),
        "provision --check": rig.meshctl("provision", new, "--check", "--json"),
        "provision": rig.meshctl("provision", new, "--yes", "--json"),
        "history": rig.meshctl("history", "", "--json"),
        "history RUN": rig.meshctl("history", "", "1", "--json"),
        "status": rig.meshctl("status", new, "--json"),
        "topology": rig.meshctl("topology", new, "--json"),
        "preflight": rig.meshctl("preflight", new, "--json"),
        "trust": rig.meshctl("trust", new, "n001", "--yes", "--json"),
        "run": rig.meshctl("run", new, "n001", "--json", command=["true"]),
        "backup": rig.meshctl("backup", new, "n001", "--out", str(rig.directory / "kept"), "--json"),
        "lab status": rig.meshctl("lab", "", "status", "--dir", str(rig.fleet.directory), "--json"),
    }
    for name, ended in found.items():
        assert ended.out, f"{name} printed nothing: {ended.err}"
    return {name: keys(ended) for name, ended in found.items()}


def test_recorded_json_keys_are_still_present(rig: Rig) -> None:
    seen = documents(rig)
    recorded: dict[str, list[str]] = json.loads(RECORDED.read_text(encoding="utf-8"))
    gone = {name: sorted(set(before) - set(seen[name])) for name, before in recorded.items()}
    assert {name: missing for name, missing in gone.items() if missing} == {}


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder), 4) as rig:
        assert rig.take_in("a").code == 0
        # twice: what depends on the moment is not recorded
        first, second = documents(rig), documents(rig)
    both = {name: sorted(set(first[name]) & set(second[name])) for name in first}
    Path(sys.argv[1]).write_text(json.dumps(both, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
