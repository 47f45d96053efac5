"""Observed nodes of one mesh, whose station tables name each other's radios."""

from __future__ import annotations

from dataclasses import replace

from meshctl.device.observation import Observation, Station, WirelessLink
from tests.meshctl.plan.support import fleet, running

MAC = "02:00:00:00:01:02"
OTHER = "02:00:00:00:01:99"
MACS = {"b01": "02:00:00:00:01:01", "b02": MAC, "b03": "02:00:00:00:01:03", "b04": "02:00:00:00:01:04"}


def node(name: str, *hears: str, connected_s: int = 500) -> Observation:
    stations = tuple(Station("mesh0", MACS[other], connected_s=connected_s) for other in hears)
    link = WirelessLink("mesh0", "IBSS", MACS[name])
    return replace(
        running(fleet(), name, neighbors=()), links=(link,), macs={}, ifindexes={"mesh0": 7}, stations=stations
    )
