"""Links that the transport was not tuned for, in virtual time: `python -m benchmarks.unfamiliar_links [--fill]`.

Each link of `udp_mesh.sim.links.cells` under the standard load, several seeds; beside it one TCP flow alone on the same
link with the same losses (models of CUBIC and BBR). Shares are payload of what the link can carry; urgent latencies
leave out the fades. Prints the mean of the seeds and the worst. `--pictures` draws one seed of each unfamiliar link
over time (docs/images/links) instead.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

from benchmarks.link_pictures import IMAGES, file_name, picture
from benchmarks.page import fill
from benchmarks.tables import row
from udp_mesh.sim.links.bbr import Bbr
from udp_mesh.sim.links.cells import CELLS, UNFAMILIAR
from udp_mesh.sim.links.cubic import Cubic
from udp_mesh.sim.links.tcp import TcpController
from udp_mesh.sim.links.trial import Trial, percentile

PICTURE_SEED = 1

COLUMNS = (
    "link", "of the link", "worst seed", "foreign flow", "urgent p50, ms", "urgent p99, ms", "worst seed, ms",
    "wire bytes per byte", "TCP cubic alone", "TCP BBR alone",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Figures:
    """One seed of one link."""

    share: float
    foreign_share: float
    urgent_p50_ms: float
    urgent_p99_ms: float
    wire_ratio: float
    cubic_share: float
    bbr_share: float


def measure(name: str, seed: int) -> Figures:
    result = Trial(CELLS[name], seed).run()
    return Figures(
        result.share,
        result.foreign_share,
        1e3 * percentile(result.urgent_s, 0.5),
        1e3 * percentile(result.urgent_s, 0.99),
        result.wire_ratio,
        _alone(name, seed, lambda seed: Cubic()),
        _alone(name, seed, lambda seed: Bbr(random.Random(seed))),
    )


def _alone(name: str, seed: int, controller: Callable[[int], TcpController]) -> float:
    """The share of a TCP flow that has the link for itself."""
    return Trial(replace(CELLS[name], senders=0, foreign=controller), seed).run().foreign_share


def line(name: str, seeds: list[Figures]) -> str:
    def mean(figure: str) -> float:
        return fmean(getattr(seed, figure) for seed in seeds)

    beside = CELLS[name].foreign is not None
    return row(
        [
            name,
            f"{mean('share'):.3f}",
            f"{min(seed.share for seed in seeds):.3f}",
            f"{mean('foreign_share'):.3f}" if beside else "",
            f"{mean('urgent_p50_ms'):.0f}",
            f"{mean('urgent_p99_ms'):.0f}",
            f"{max(seed.urgent_p99_ms for seed in seeds):.0f}",
            f"{mean('wire_ratio'):.3f}",
            f"{mean('cubic_share'):.3f}",
            f"{mean('bbr_share'):.3f}",
        ]
    )


def draw(name: str) -> None:
    (IMAGES / file_name(name)).write_text(picture(Trial(CELLS[name], PICTURE_SEED).run()), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.unfamiliar_links", description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    parser.add_argument("--pictures", action="store_true", help="draw the unfamiliar links to docs/images/links")
    parser.add_argument("--only", default="", help="links whose names contain this")
    arguments = parser.parse_args()
    if arguments.fill and arguments.only:
        parser.error("--fill writes the table of all links: leave out --only")
    if arguments.pictures:
        IMAGES.mkdir(parents=True, exist_ok=True)
        for cell in UNFAMILIAR:
            if arguments.only in cell.name:
                draw(cell.name)
                print(file_name(cell.name), flush=True)
        return
    seeds = range(1, arguments.seeds + 1)
    lines = [row(COLUMNS), row(["---"] * len(COLUMNS))]
    with ProcessPoolExecutor() as pool:
        for name in CELLS:
            if arguments.only not in name:
                continue
            lines.append(line(name, list(pool.map(partial(measure, name), seeds))))
            print(lines[-1], flush=True)
    if arguments.fill:
        fill("unfamiliar links", "\n".join(lines))


if __name__ == "__main__":
    main()
