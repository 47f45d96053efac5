"""The devices that were replaced are known by their MACs."""

from __future__ import annotations

from dataclasses import replace

from meshctl.fleet.journal import LastKnown
from meshctl.nodes.former_devices import facts_of_former_device, former_devices
from tests.meshctl.plan.support import fleet

FIRST, SECOND, WRITTEN = "04:4d:00:00:00:01", "04:4d:00:00:00:02", "04:4d:00:00:00:03"


def test_the_macs_of_each_earlier_device_are_kept() -> None:
    node = replace(fleet().nodes["b01"], mac=WRITTEN.upper())
    key, facts = facts_of_former_device(node, {"b01": LastKnown("b01", 1.0, {"macs": FIRST})})
    assert (key, facts) == ("former.b01", {"macs": f"{FIRST} {WRITTEN}"})
    known = {key: LastKnown(key, 1.0, facts), "b01": LastKnown("b01", 2.0, {"macs": SECOND})}
    assert former_devices(known)[FIRST] == "b01"
    assert SECOND not in former_devices(known)
    # the second device is replaced, too
    _, facts = facts_of_former_device(node, known)
    assert facts["macs"].split() == [FIRST, WRITTEN, SECOND]


def test_a_radio_of_a_former_device_is_known_by_its_other_addresses() -> None:
    key, facts = facts_of_former_device(fleet().nodes["b01"], {"b01": LastKnown("b01", 1.0, {"macs": FIRST})})
    assert former_devices({key: LastKnown(key, 1.0, facts)})["06" + FIRST[2:]] == "b01"


def test_a_device_without_a_known_mac_leaves_nothing() -> None:
    assert facts_of_former_device(fleet().nodes["b01"], {})[1] == {}
