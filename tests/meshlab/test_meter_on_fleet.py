"""The placement meter on a virtual fleet: its script on the nodes' own shell, and a robot that moves."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from functools import partial

import pytest

from meshctl.device.connection import Completed, Connection, Endpoint
from meshctl.device.link_table import LinkTable, read_links
from meshctl.nodes.link_snapshots import HopMargins, MeshTables, assemble
from meshctl.placement.ground import NodePosition
from meshctl.placement.meter import Advice, LinkSnapshot, Meter
from meshctl.placement.path_loss import PathLossModel
from meshlab import placement
from meshlab.fleet import VirtualFleet, VirtualNode
from meshlab.propagation import RadioEnvironment, links_of
from tests.meshlab.conftest import LINE
from tests.meshlab.test_ground_on_fleet import lab, mac_of
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]

# far is the robot; beyond 100 m it hears near alone
ROW = RadioEnvironment(
    {"base": NodePosition((0, 0)), "near": NodePosition((60, 0)), "far": NodePosition((97, 0))},
    path_loss=PathLossModel(exponent=4.0),
)


class Shell(Connection):
    """A node's shell as a connection."""

    def __init__(self, node: VirtualNode) -> None:
        self._node = node

    @property
    def endpoint(self) -> Endpoint:
        return Endpoint("", identity=self._node.name)

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        return self._node.exec(script)

    def close(self) -> None:
        """Nothing is open."""


@pytest.fixture
def row(mesh: VirtualFleet) -> Iterator[VirtualFleet]:
    placement.set_environment(mesh, ROW)
    yield mesh
    placement.set_environment(mesh, RadioEnvironment(links=mesh.spec.links))
    (mesh.directory / "ground.json").unlink()


def tables(fleet: VirtualFleet) -> MeshTables:
    """What every node's radio reports now."""
    macs = {mac_of(fleet, name): name for name in LINE}
    base = [mac for mac, name in macs.items() if name == "base"]
    found: dict[str, LinkTable] = {
        name: read_links(Shell(fleet.node(name)), base, timeout_s=60.0, clock=time.time) for name in LINE
    }
    return MeshTables(found, macs, ("far",), "base")


def snapshot(fleet: VirtualFleet, margins: HopMargins, now_s: float) -> LinkSnapshot:
    x, y = fleet.positions["far"]
    return assemble(tables(fleet), margins, now_s, fresh=True, position=(x, y, 0.0))


def test_the_meter_follows_a_robot_that_moves(row: VirtualFleet) -> None:
    meter, margins = Meter(7.0), HopMargins(7.0)
    until(lambda: {"near"} <= set(snapshot(row, margins, 0.0).paths), "far's path over near")
    steps = (97, 101, 105, 109, 113, 117, 121)
    readings = []
    for second, x in enumerate(steps):
        lab(row, "move", "far", str(x), "0")
        (link,) = (one for one in links_of(placement.current_environment(row)) if one.ends == {"near", "far"})
        until(partial(hears, row, link.signal_at("far")), f"the signal at {x} m")
        readings.append(meter.step(snapshot(row, margins, float(second))))
    assert [one.next_hop for one in readings[-3:]] == ["near"] * 3
    assert readings[-1].hops == 2
    ratios = [one.snr_db for one in readings[-3:] if one.snr_db is not None]
    assert len(ratios) == 3
    assert ratios == sorted(ratios, reverse=True)
    # 40 log10 of 61 / 41 m over the last 20 m
    assert readings[-1].slope_db_per_m == pytest.approx(-0.35, abs=0.1)
    assert readings[0].advice is Advice.GO
    lab(row, "move", "far", "900", "0")
    until(lambda: heard(row) is None, "far to hear no one")
    lost = [meter.step(snapshot(row, margins, 20.0 + second)) for second in range(4)]
    assert lost[-1].advice is Advice.TURN_BACK
    assert lost[-1].back_m == pytest.approx(900 - 121, abs=40)


def hears(fleet: VirtualFleet, signal_dbm: int) -> bool:
    return heard(fleet) == signal_dbm


def heard(fleet: VirtualFleet) -> int | None:
    """The signal at which far hears near."""
    mac = mac_of(fleet, "near")
    table = read_links(Shell(fleet.node("far")), [mac], timeout_s=60.0)
    return table.signals_dbm.get(mac)
