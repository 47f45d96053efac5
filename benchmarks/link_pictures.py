"""A picture of each unfamiliar link: its rate, goodput and the latency of urgent messages over time, as SVG."""

from __future__ import annotations

import re
from pathlib import Path

from benchmarks.line_chart import HEIGHT, WIDTH, color, over_time
from udp_mesh.sim.links.trial import Result

IMAGES = Path(__file__).parents[1] / "docs" / "images" / "links"
LATENCY_STEP_S = 0.25
"""Of the urgent messages sent in each step, the slowest is drawn."""

_STYLE = "text{font:11px system-ui,sans-serif;fill:#444}.grid{stroke:#e4e4e4}"
_LEGEND_HEIGHT = 24


def file_name(link: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", link.lower()).strip("-") + ".svg"


def picture(result: Result) -> str:
    """An SVG of two charts, one below the other."""
    timeline = result.timeline
    rates = {"goodput": [(moment.at_s, moment.goodput_bits_per_s / 1e6) for moment in timeline]}
    if any(moment.foreign_bits_per_s for moment in timeline):
        rates["foreign flow"] = [(moment.at_s, moment.foreign_bits_per_s / 1e6) for moment in timeline]
    link = [(moment.at_s, moment.link_bits_per_s / 1e6) for moment in timeline if moment.link_bits_per_s is not None]
    if link:
        rates["rate of the link"] = link
    slowest: dict[int, float] = {}
    for sent_s, latency_s in result.urgent_at:
        step = int(sent_s / LATENCY_STEP_S)
        slowest[step] = max(slowest.get(step, 0.0), 1e3 * latency_s)
    latencies = {"urgent": [(step * LATENCY_STEP_S, latency_ms) for step, latency_ms in sorted(slowest.items())]}
    end_s = timeline[-1].at_s
    charts = [
        over_time(rates, end_s, "seconds", "Mbit/s"),
        over_time(latencies, end_s, "seconds", "urgent latency, ms"),
    ]
    legend = "".join(
        f'<rect x="{64 + 130 * place}" y="6" width="10" height="10" fill="{color(place)}"/>'
        f'<text x="{80 + 130 * place}" y="15">{name}</text>'
        for place, name in enumerate(rates)
    )
    placed = "".join(
        chart.replace("<svg ", f'<svg y="{_LEGEND_HEIGHT + place * HEIGHT}" width="{WIDTH}" height="{HEIGHT}" ', 1)
        for place, chart in enumerate(charts)
    )
    height = _LEGEND_HEIGHT + len(charts) * HEIGHT
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}"><style>{_STYLE}</style>'
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>{legend}{placed}</svg>\n'
    )
