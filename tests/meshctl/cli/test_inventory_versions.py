"""Commands that run for hours notice that the inventory was edited: the meter, how many beacons are left on board."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from meshctl.cli.inventory_versions import BeaconStock
from meshctl.inventory.edit import Editor, save, set_state
from meshctl.inventory.load import load_fleet
from meshctl.model import NodeState
from meshctl.resources import shipped


def test_the_stock_follows_what_deployed_marks(tmp_path: Path) -> None:
    inventory = Path(shutil.copytree(shipped("inventory") / "starter", tmp_path / "fleet"))
    stock = BeaconStock(load_fleet(inventory, environ=os.environ), "rover1")
    assert stock.count() == 6
    editor = Editor.open(inventory)
    set_state(editor, "rover1-b03", NodeState.DEPLOYED)
    save(editor.changes())
    assert stock.count() == 5
    assert stock.names() == {"rover1-b01", "rover1-b02", "rover1-b04", "rover1-b05", "rover1-b06"}
    file = inventory / "fleet.yaml"
    text = file.read_text(encoding="utf-8")
    file.write_text(text + "nodes: [half an edit", encoding="utf-8")
    assert stock.count() == 5
    editor_of = text.replace("state: deployed}", "state: carried}   ")
    file.write_text(editor_of, encoding="utf-8")
    assert stock.count() == 6


def test_a_robot_without_beacons_has_no_stock(tmp_path: Path) -> None:
    inventory = Path(shutil.copytree(shipped("inventory") / "starter", tmp_path / "fleet"))
    fleet = load_fleet(inventory, environ=os.environ)
    assert BeaconStock(fleet, "base-station").count() is None
    # a node that moves with a robot
    assert BeaconStock(fleet, "rover1-radio").count() is None
    assert len(BeaconStock(fleet, "rover1-radio").names()) == 6
    assert BeaconStock(fleet, "base-station").names() == frozenset()
