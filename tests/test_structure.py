"""The structure that a reader relies on: a class name means one thing in a package, and no module imports itself around
a circle."""

from __future__ import annotations

import ast
from collections import defaultdict
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("meshctl", "meshlab", "mesh_sweep", "udp_mesh")
# ROS 1, ROS 2 and Zenoh each have one, in a process of its own
SHARED = {"Bridge"}


@pytest.mark.parametrize("package", PACKAGES)
def test_public_class_names_are_unique_within_a_package(package: str) -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for file in sorted((ROOT / package).rglob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(str(file.relative_to(ROOT)))
    assert {name: files for name, files in places.items() if len(files) > 1 and name not in SHARED} == {}


# lines; a test file mirrors one module, and may be longer than that
MAX_LINES, MAX_TEST_LINES = 400, 500
# the control law and the sender are one state machine each: their parts change the same dozen variables
LONG = {
    "udp_mesh/core/congestion/delay_based.py": 460,
    "udp_mesh/core/sender/sender.py": 440,
    # Programs copy this one file.
    "udp_mesh/client/mesh_client.py": 490,
}


@pytest.mark.parametrize("folder", [*PACKAGES, "docgen", "benchmarks", "tests"])
def test_a_file_is_short_enough_to_read(folder: str) -> None:
    limit = MAX_TEST_LINES if folder == "tests" else MAX_LINES
    lengths = {
        str(file.relative_to(ROOT)): len(file.read_text(encoding="utf-8").splitlines())
        for file in sorted((ROOT / folder).rglob("*.py"))
    }
    assert lengths
    assert {name: length for name, length in lengths.items() if length > LONG.get(name, limit)} == {}


def test_no_program_imports_from_the_current_directory() -> None:
    """`python -m` does, and the current directory may be an inventory of a stranger: `-P` leaves it out."""
    sources = {
        file: file.read_text(encoding="utf-8") for package in PACKAGES for file in (ROOT / package).rglob("*.py")
    }
    assert [str(file.relative_to(ROOT)) for file, text in sources.items() if 'sys.executable, "-m"' in text] == []


def test_no_import_cycles() -> None:
    """Imports for types alone count, too."""
    graph = grimp.build_graph(*PACKAGES, exclude_type_checking_imports=False)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))
