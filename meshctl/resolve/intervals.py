"""Target reconnect time -> batman-adv's intervals.

BATMAN_IV detects a dead path by missing originator messages, so the time to heal depends on their interval. The values
were measured with the Linux kernel's batman-adv: a diamond of four nodes, with one of the two paths cut.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from meshctl.model import Mesh

# Originator interval in ms -> the longest measured time to heal, in s.
MEASURED_HEAL_S: dict[int, float] = {1000: 5.0, 500: 2.9, 250: 1.35, 100: 0.6}
LONGEST_MEASURED_MS = max(MEASURED_HEAL_S)

# batman-adv's default ELP interval, used by BATMAN_V (bat_v_elp.c).
DEFAULT_ELP_INTERVAL_MS = 500


@dataclass(frozen=True, slots=True)
class Intervals:
    """`orig_interval_ms` for the mesh interface, `elp_interval_ms` for each radio (BATMAN_V only)."""

    orig_interval_ms: int
    elp_interval_ms: int


class UnreachableTarget(ValueError):
    """A reconnect time shorter than any measured one; `fastest_s` is the shortest."""

    def __init__(self, wanted_s: float, fastest_s: float) -> None:
        super().__init__(f"expected at least {fastest_s:g} s, found {wanted_s:g} s")
        self.fastest_s = fastest_s


def batman_intervals(mesh: Mesh) -> Intervals:
    """The intervals set in the inventory, or else the longest that heals within `mesh.reconnect_s`.

    The longest, because every originator message costs airtime (`originator_airtime`). Raises UnreachableTarget.
    """
    written = mesh.batman.orig_interval_ms
    orig_ms = written if written is not None else originator_interval_ms(mesh.reconnect_s)
    elp_ms = mesh.batman.elp_interval_ms
    if elp_ms is None:
        # links must be probed at least twice per originator interval, or routes use stale links
        elp_ms = min(DEFAULT_ELP_INTERVAL_MS, orig_ms // 2)
    return Intervals(orig_ms, elp_ms)


def originator_interval_ms(reconnect_s: float) -> int:
    """The longest measured interval that heals within `reconnect_s`. Raises UnreachableTarget if there is none."""
    fitting = [interval for interval, heal_s in MEASURED_HEAL_S.items() if heal_s <= reconnect_s]
    if not fitting:
        raise UnreachableTarget(reconnect_s, min(MEASURED_HEAL_S.values()))
    return max(fitting)


def heal_s(orig_interval_ms: int) -> float:
    """The expected maximum time to heal: interpolated between the measurements, proportional beyond them."""
    points = sorted(MEASURED_HEAL_S.items())
    first_ms, first_s = points[0]
    last_ms, last_s = points[-1]
    if orig_interval_ms <= first_ms:
        return first_s * orig_interval_ms / first_ms
    if orig_interval_ms >= last_ms:
        return last_s * orig_interval_ms / last_ms
    (low_ms, low_s), (high_ms, high_s) = next(pair for pair in pairwise(points) if orig_interval_ms <= pair[1][0])
    return low_s + (high_s - low_s) * (orig_interval_ms - low_ms) / (high_ms - low_ms)
