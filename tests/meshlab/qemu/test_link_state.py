"""Link state of a QEMU fleet, with a node that is not ready for a change."""

from __future__ import annotations

import asyncio

import pytest

from meshlab.errors import LabError
from meshlab.fleet_state import FleetState
from meshlab.qemu import hwsim_devices
from meshlab.qemu.link_state import QemuLinkState
from meshlab.spec import FleetSpec, NodeSpec
from meshlab.state import NodeState, Power


def test_a_failed_cable_connection_is_retried_without_another_change(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = FleetSpec("x", (NodeSpec("b01"),))
    state = NodeState(spec.nodes[0], 0, tmp_path_factory.mktemp("b01"), plugged=True, power=Power.UP, pid=7, boots=1)
    tries: list[str] = []

    async def run() -> None:
        is_laid = asyncio.Event()

        def connect_cable(place: hwsim_devices.NodeHardware, *_: object, on_bench: bool) -> None:
            tries.append(place.name)
            if len(tries) == 1:
                raise LabError("ip link set cable0: Cannot find device")
            is_laid.set()

        monkeypatch.setattr(hwsim_devices, "connect_cable", connect_cable)
        monkeypatch.setattr(hwsim_devices, "set_group", lambda *_: None)
        fleet = FleetState(spec, state.home)
        fleet.nodes["b01"] = state
        QemuLinkState(fleet, hwsim_devices.node_hardware(spec)).changed()
        await asyncio.wait_for(is_laid.wait(), 60)

    asyncio.run(run())
    assert tries == ["b01", "b01"]
