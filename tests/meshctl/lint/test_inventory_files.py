"""Which files beside the inventory are reported as not included (MC007)."""

from pathlib import Path

import pytest

from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
NORTH = "# the north\n---\nnodes:\n  b09: {address: 10.42.0.109}\n"


def reported(directory: Path, fragment: str, **files: str) -> list[tuple[str, int]]:
    """The message and line of each finding."""
    example = Example(fragment, files={f"{name}.yaml": text for name, text in files.items()})
    path = write(example, directory)
    found = check_path(path, _REGDB, environment(example)).diagnostics
    return [(item.text, item.position.line) for item in found if item.code == "MC007"]


def test_a_part_of_an_inventory_that_no_file_includes_is_reported_at_the_list(tmp_path: Path) -> None:
    files = {"north": NORTH, "south": "robots: {}\n"}
    [(text, line)] = reported(tmp_path, "include: [south.yaml]", **files)
    assert "north.yaml is not in the inventory" in text
    assert (tmp_path / "fleet.yaml").read_text().splitlines()[line - 1].startswith("include:")


@pytest.mark.parametrize(
    "files",
    [
        {"docker-compose": "services:\n  nodes: {}\nnetworks: {}\n"},
        {"playbook": "- hosts: all\n  nodes: []\n"},
        {"secrets": "mesh_key: cedar-lantern-93-quarry\n"},
        {"notes": "nodes: {b09: {address: 10.42.0.109}}\nremark: of last year\n"},
        {"empty": "", "binary": "\0\ufffd"},
        # another fleet, and its part
        {"other": "meshctl: 1\nfleet: other\ncountry: US\ninclude:\n  - north.yaml\n", "north": NORTH},
    ],
)
def test_files_of_others_are_not_reported(tmp_path: Path, files: dict[str, str]) -> None:
    assert reported(tmp_path, "fleet: mine", **files) == []


def test_a_folder_with_very_many_files_is_not_one_of_an_inventory(tmp_path: Path) -> None:
    for number in range(1001):
        (tmp_path / f"log{number}").touch()
    assert reported(tmp_path, "fleet: mine", north=NORTH) == []


def test_a_folder_reached_by_two_paths_is_looked_at_once(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    assert reported(tmp_path, "include: [sub/../north.yaml]", north=NORTH) == []
