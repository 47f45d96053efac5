"""A plan refuses the flash that provisioning would refuse: the image is checked when the plan is made."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from meshctl.apply.images import CheckedImages
from meshctl.apply.prepare import PlanOptions, assemble
from meshctl.firmware import append_metadata
from meshctl.inventory import load_fleet
from meshctl.nodes.collect import FleetObservation
from meshctl.nodes.desired import Renderer
from meshctl.plan import Verdict
from tests.meshctl.plan.support import INVENTORY, SALT, running, secret

FIRMWARE = "firmware: {image: box.bin, revision: r24106}"


@pytest.mark.parametrize(
    ("board", "refusal"),
    [
        ("compex,wpj344-16m", ""),
        (
            "ubnt,rocket-m",
            "its firmware image box.bin: made for another board: expected compex,wpj344-16m, found ubnt,rocket-m "
            "[FW005]",
        ),
    ],
)
def test_a_node_whose_image_is_for_another_board_is_refused_by_the_plan(
    board: str, refusal: str, tmp_path: Path
) -> None:
    text = INVENTORY.format(channel=6, max_down=1, canary="false", firmware=FIRMWARE)
    (tmp_path / "fleet.yaml").write_text(text, encoding="utf-8")
    metadata = {"supported_devices": [board], "version": {"version": "23.05.5", "revision": "r24106"}}
    (tmp_path / "box.bin").write_bytes(append_metadata(b"image", metadata))
    team = load_fleet(tmp_path)
    renderer = Renderer.of(team, secret)
    rendered = {name: renderer.desired(team.nodes[name]) for name in ("b01", "b02")}
    seen = FleetObservation({name: running(team, name) for name in rendered}, {})
    pool: Any = SimpleNamespace(own_keys=lambda node: None, former_places=dict)
    plan = assemble(renderer, pool, rendered, seen, {}, salt=SALT, owner="ann", choices=PlanOptions()).plan
    verdict = Verdict.REFUSED if refusal else Verdict.CHANGE
    assert {(made.verdict, made.reason, made.firmware is None) for made in plan.nodes.values()} == {
        (verdict, refusal, bool(refusal))
    }
    without = PlanOptions(with_firmware=False)
    plan = assemble(renderer, pool, rendered, seen, {}, salt=SALT, owner="ann", choices=without).plan
    assert not plan.of(Verdict.REFUSED)


def test_each_image_is_read_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    text = INVENTORY.format(channel=6, max_down=1, canary="false", firmware=FIRMWARE)
    (tmp_path / "fleet.yaml").write_text(text, encoding="utf-8")
    profile = load_fleet(tmp_path).hardware["box"]
    images = CheckedImages()
    first = images.faults(profile)
    assert "box.bin: cannot be read: No such file or directory [FW001]" in first
    (tmp_path / "box.bin").write_bytes(b"image")
    assert images.faults(profile) == first
