"""Unexpected requests: each is answered, and the fleet keeps running."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from meshctl.errors import InputError
from meshlab.client import request
from meshlab.control import Control, Operations
from meshlab.errors import LabError
from meshlab.fleet import VirtualFleet
from meshlab.spec import FleetSpec, NodeSpec, dump, load


class Faulty(Operations):
    """The operations of a fleet, with a bug in one."""

    def __init__(self) -> None:
        """Without a fleet."""

    def status(self) -> dict[str, Any]:
        return {"power": {"b01": "up"}["b02"]}

    def down(self) -> None:
        raise LabError("not now", hint="later")


def asked(directory: Path, *messages: dict[str, Any]) -> list[str]:
    """The error messages that the fleet's socket returns."""

    async def serve() -> list[str]:
        control = Control(directory, Faulty().answer)
        control.open()
        try:
            return [await asyncio.to_thread(refusal, message) for message in messages]
        finally:
            control.close()

    def refusal(message: dict[str, Any]) -> str:
        with pytest.raises(InputError) as caught:
            request(directory, message)
        return str(caught.value)

    return asyncio.run(serve())


def test_an_internal_error_is_returned_and_the_next_request_is_still_served(tmp_path: Path) -> None:
    answers = asked(tmp_path, {"op": "status"}, {"op": "no_such"}, {"op": "mend", "what": 1}, {"op": "down"})
    assert answers[0] == "the lab failed at 'status': KeyError: 'b02'"
    assert answers[1].startswith("the lab failed at 'no_such': AttributeError")
    assert answers[2].startswith("the lab failed at 'mend': TypeError")
    assert answers[3] == "not now"


def test_a_spec_of_another_version_is_rejected_with_a_hint() -> None:
    spec = json.loads(dump(FleetSpec("old", (NodeSpec("b01"),))))
    without = {key: value for key, value in spec.items() if key != "lans"}
    with pytest.raises(InputError, match="found nothing under 'lans'") as caught:
        load(json.dumps(without))
    assert "meshctl lab down" in caught.value.hint
    with pytest.raises(InputError, match="unexpected keyword"):
        load(json.dumps({**spec, "gravity": 1}))
    with pytest.raises(InputError, match="found Expecting property name"):
        load("{")


@pytest.mark.lab
@pytest.mark.xdist_group("lab")
def test_a_fleet_can_be_stopped_without_a_valid_spec(tmp_path: Path) -> None:
    with VirtualFleet(FleetSpec("old", (NodeSpec("b01", host_key_types=("ed25519",)),)), tmp_path / "fleet") as fleet:
        (fleet.directory / "spec.json").write_text("{}")
        with pytest.raises(InputError):
            VirtualFleet.attach(fleet.directory)
        fleet.down()
        with pytest.raises(LabError):
            fleet.status()
