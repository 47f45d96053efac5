"""The links on which the transport is judged: those it was tuned to (`FAMILIAR`) and others (`UNFAMILIAR`)."""

from __future__ import annotations

import random

from udp_mesh.sim.links.bbr import Bbr
from udp_mesh.sim.links.cubic import Cubic
from udp_mesh.sim.links.path import Link
from udp_mesh.sim.links.traces import Steps, constant, handovers, mtu_hole, wifi_rate_walk
from udp_mesh.sim.links.trial import MEET_S, Cell, Chain

_END_S = 60.0
"""Traces last this long."""


def _steady(rate: float, round_trip_s: float, loss: float, queue_packets: int = 100) -> Link:
    return Link(constant(rate), constant(round_trip_s / 2), queue_packets=queue_packets, loss=loss)


def _wifi(seed: int) -> Link:
    return Link(wifi_rate_walk(seed, _END_S), constant(0.005), queue_packets=300, stalls_per_s=8.0)


def _rerouted(seed: int) -> Link:
    hole_at_s = random.Random(f"hole {seed}").uniform(14.0, 18.0)
    return Link(delay_s=handovers(seed, _END_S), mtu=mtu_hole(hole_at_s, 1300), queue_packets=100, reorder_share=0.01)


def _changing(rate: float, delay_s: float) -> Link:
    at = MEET_S + 8.0
    return Link(Steps((0.0, at), (10e6, rate)), Steps((0.0, at), (0.010, delay_s)), loss=0.02)


UNFAMILIAR = (
    Cell("beside cubic", lambda seed: _steady(10e6, 0.020, 0.0), foreign=lambda seed: Cubic(), warm_up_s=10.0,
         duration_s=40.0),
    Cell("beside BBR", lambda seed: _steady(10e6, 0.020, 0.0), foreign=lambda seed: Bbr(random.Random(seed)),
         warm_up_s=10.0, duration_s=40.0),
    Cell("600 ms, 2 %", lambda seed: _steady(10e6, 0.600, 0.02, 600), warm_up_s=8.0, duration_s=40.0),
    Cell("wifi rate walk", _wifi, duration_s=25.0),
    Cell("route 10 and 150 ms, MTU hole", _rerouted, warm_up_s=4.0, duration_s=38.0),
    Cell("four senders", lambda seed: _steady(10e6, 0.020, 0.0), senders=4),
    Cell("three half-duplex hops", chain=Chain(3, 10e6, 100e-6, 0.10)),
)  # fmt: skip

FAMILIAR = (
    Cell("0 %", lambda seed: _steady(10e6, 0.020, 0.0)),
    Cell("5 %", lambda seed: _steady(10e6, 0.020, 0.05)),
    Cell("20 %", lambda seed: _steady(10e6, 0.020, 0.20)),
    Cell("2 ms, 0 %", lambda seed: _steady(10e6, 0.002, 0.0)),
    Cell("100 ms, 0 %", lambda seed: _steady(10e6, 0.100, 0.0)),
    Cell("100 ms, 20 %", lambda seed: _steady(10e6, 0.100, 0.20)),
    Cell("1 Mbit/s, 5 %", lambda seed: _steady(1e6, 0.020, 0.05)),
    Cell("20 Mbit/s, 5 %", lambda seed: _steady(20e6, 0.020, 0.05), duration_s=20.0),
    Cell("10 to 2 Mbit/s", lambda seed: _changing(2e6, 0.010), warm_up_s=8.0, duration_s=16.0),
    Cell("20 to 60 ms", lambda seed: _changing(10e6, 0.030), warm_up_s=8.0, duration_s=16.0),
    Cell("half duplex", chain=Chain(1, 10e6, 100e-6, 0.0)),
)

CELLS = {cell.name: cell for cell in (*FAMILIAR, *UNFAMILIAR)}
