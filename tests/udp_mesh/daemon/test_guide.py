"""The guide names everything that can be configured, and its examples work."""

import dataclasses
import re
from pathlib import Path

import pytest

import udp_mesh
from udp_mesh.core.settings import Limits, Rates, Topic
from udp_mesh.daemon.commands import COMMANDS
from udp_mesh.daemon.configuration import DaemonSettings, load
from udp_mesh.daemon.service import REJECTION_CODES

DOCS = Path(udp_mesh.__file__).parents[1] / "docs"


@pytest.mark.parametrize("values", [Topic, Rates, Limits, DaemonSettings])
def test_every_key_of_the_configuration_is_in_the_guide(values: type) -> None:
    guide = (DOCS / "udp-mesh.md").read_text()
    missing = [item.name for item in dataclasses.fields(values) if f"`{item.name}`" not in guide]
    assert [name for name in missing if name != "name"] == []


def test_every_request_and_refusal_is_in_the_local_apis_page() -> None:
    page = (DOCS / "local-api.md").read_text()
    assert [word for word in (*COMMANDS, *REJECTION_CODES) if f"`{word}`" not in page] == []


def test_configuration_examples_in_the_guide_load(tmp_path: Path) -> None:
    guide = (DOCS / "udp-mesh.md").read_text()
    blocks = re.findall(r"(?:^    .*\n|^\n(?=    ))+", guide, re.MULTILINE)
    examples = [re.sub(r"^    ", "", block, flags=re.MULTILINE) for block in blocks]
    topics = next(text for text in examples if "artifacts" in text)
    links = next(text for text in examples if 'interface = "bat0"' in text)
    (tmp_path / "fleet.key").write_text("5a" * 32)
    path = tmp_path / "udp-mesh.toml"
    path.write_text(f'key_file = "fleet.key"\n{topics}\n{links}')
    configuration = load(path)
    assert {topic.name for topic in configuration.settings.topics} >= {"status", "artifacts", "map/diff", "video"}
    assert len(configuration.links) == 2
    assert configuration.settings.neighbours[0].legacy


def test_every_test_and_benchmark_that_the_threat_model_names_exists() -> None:
    page = (DOCS / "threat-model.md").read_text()
    tests = set(re.findall(r"`(\w+/(?:\w+/)*test_\w+\.py)`", page))
    assert len(tests) >= 15
    assert [name for name in sorted(tests) if not (DOCS.parent / "tests" / "udp_mesh" / name).exists()] == []
    figures = set(re.findall(r"`(benchmarks/[\w/.]+)`", page))
    assert [name for name in sorted(figures) if not (DOCS.parent / name).exists()] == []
