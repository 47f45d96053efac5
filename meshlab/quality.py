"""Frame loss on a link <-> BATMAN_IV's transmit quality (TQ), as net/batman-adv/bat_iv_ogm.c derives it from OGMs.

A node's TQ toward a neighbor is the share of its own OGMs that the neighbor echoes back, less a penalty for link
asymmetry: tq = 255 * (1 - loss there) * (1 - loss back ** 3).
"""

from __future__ import annotations

TQ_MAX = 255


def tq_of(loss_there: float, loss_back: float) -> int:
    """The TQ (0..255) of sending over a link that loses these shares (0..1) of frames in each direction.

    Source: `batadv_iv_ogm_calc_tq`, with exact shares instead of a window of 64 OGMs.
    """
    return int(TQ_MAX * (1.0 - loss_there) * (1.0 - loss_back**3) + 0.5)


def loss_of(tq: int) -> float:
    """The symmetric loss, to the nearest thousandth, that gives a link this TQ: the inverse of `tq_of`."""
    low, high = 0.0, 1.0
    while high - low > 1e-6:
        middle = (low + high) / 2
        if TQ_MAX * (1.0 - middle) * (1.0 - middle**3) > tq:
            low = middle
        else:
            high = middle
    return round(low, 3)
