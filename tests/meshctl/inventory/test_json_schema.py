"""The JSON Schema and the loader say the same."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator  # type: ignore[import-untyped]

from meshctl.inventory.json_schema import json_schema
from tests.meshctl.inventory.inventories import SHIPPED, load_text


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    return Draft202012Validator(json_schema())


def _example() -> dict[str, Any]:
    parts = [yaml.safe_load((SHIPPED / "subt-final" / name).read_text()) for name in ("fleet.yaml", "topics.yaml")]
    return {**parts[0], **parts[1]}


def test_the_schema_is_valid_draft_2020_12() -> None:
    schema = json_schema()
    Draft202012Validator.check_schema(schema)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"


def test_every_key_has_a_description() -> None:
    def check(value: Any, path: str) -> None:
        for name, item in value.get("properties", {}).items():
            assert item.get("description"), f"{path}.{name}"

    schema = json_schema()
    check(schema, "")
    for name, definition in schema["$defs"].items():
        check(definition, name)


def test_the_examples_validate_against_the_schema(validator: Draft202012Validator) -> None:
    assert list(validator.iter_errors(_example())) == []
    starter = yaml.safe_load((SHIPPED / "starter" / "fleet.yaml").read_text())
    assert list(validator.iter_errors(starter)) == []


def test_an_included_file_satisfies_it_by_itself(validator: Draft202012Validator) -> None:
    topics = yaml.safe_load((SHIPPED / "subt-final" / "topics.yaml").read_text())
    assert "meshctl" not in topics
    assert list(validator.iter_errors(topics)) == []
    assert list(validator.iter_errors({**topics, "tpoics": {}})) != []


@pytest.mark.parametrize("key", ["fleet", "country"])
def test_the_main_file_requires_fleet_and_country(key: str, validator: Draft202012Validator) -> None:
    document = _example()
    del document[key]
    assert list(validator.iter_errors(document)) != []


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("aply",), {}),
        (("nodes", "base", "rol"), "base"),
        (("nodes", "base", "role"), "bass"),
        (("nodes", "base", "address"), "tomorrow"),
        (("nodes", "base", "mac"), "02:00"),
        (("meshes", "main", "channel"), "auto"),
        (("meshes", "main", "key"), "plain text"),
        (("topics", "fpv", "priority"), 16),
        (("udp_mesh", "window"), 0),
        (("udp_mesh", "relay_hops"), 9),
        (("robots", "husky1", "relay"), "uav1"),
        (("country",), "us"),
        (("meshctl",), 2),
        (("hardware", "rocket", "release"), "18.06"),
        (("operators", "ssh_keys"), "ssh-ed25519 AAAA"),
    ],
)
def test_values_rejected_by_the_loader_are_rejected_by_the_schema(
    path: tuple[str, ...], value: Any, validator: Draft202012Validator, tmp_path: Path
) -> None:
    document = copy.deepcopy(_example())
    del document["include"]
    place = document
    for part in path[:-1]:
        place = place[part]
    assert list(validator.iter_errors(document)) == []
    place[path[-1]] = value
    assert list(validator.iter_errors(document)) != []
    # The release is a number in YAML's eyes, so the text is dumped with its quotes.
    assert load_text(tmp_path, yaml.safe_dump(document)).fleet is None


def test_unquoted_values_accepted_by_the_loader_are_accepted_by_the_schema(validator: Draft202012Validator) -> None:
    document = _example()
    document["hardware"]["rocket"]["release"] = 24.10
    document["nodes"]["spare"] = None
    document["nodes"]["base"].update({"label": 17, "serial": 20261201, "groups": [2026]})
    document["meshes"]["main"]["ssid"] = 4711
    document["hardware"]["sector"]["switch_vlans"] = {"1": 3}
    # text in YAML 1.2, by which editors read
    document["apply"]["canary"] = "yes"
    assert list(validator.iter_errors(document)) == []
    document["apply"]["canary"] = "maybe"
    assert list(validator.iter_errors(document)) != []
