"""A comparison as one HTML page without scripts and without anything to load. Pure."""

from __future__ import annotations

from html import escape

from mesh_sweep.cases import settings_text
from mesh_sweep.comparison import ComparedFigure, Comparison, number, row_texts
from mesh_sweep.results import Identity

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#1a1a1a;background:#fff}
h2{font-size:1.1rem;margin:2rem 0 .3rem}table{border-collapse:collapse;width:100%}
th,td{text-align:left;padding:.25rem .8rem .25rem 0;border-bottom:1px solid #ddd;font-variant-numeric:tabular-nums}
svg{width:100%;height:auto}.failed{border-left:4px solid #b00020;padding-left:1rem}
@media(prefers-color-scheme:dark){body{color:#e6e6e6;background:#161616}th,td{border-color:#444}}
"""
_WIDTH, _LABEL, _ROW = 960, 300, 26
_MAX_ROWS = 60
"""More settings than this are in the table alone."""


def page(identity: Identity, comparison: Comparison) -> str:
    """The whole page: each figure with its chart and its table."""
    head = (
        f"<p>{comparison.runs} runs of {escape(str(identity))}. Lines are 95 % confidence intervals: Student's for "
        "means, Wilson's for shares of runs. Differences are means over runs with the same seeds. Each interval stands "
        "for itself: of twenty such lines, one misses on average.</p>"
    )
    parts = "".join(_figure(figure) for figure in comparison.figures)
    title = f"{escape(identity.scenario)}: sweep"
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1>{head}{_failed(comparison)}"
        f"{parts}</body></html>\n"
    )


def _failed(comparison: Comparison) -> str:
    if not comparison.failed:
        return ""
    items = "".join(
        f"<li>{escape(str(result.case))}: {escape(result.failed)}</li>" for result in comparison.failed[:20]
    )
    return f'<div class="failed"><p>{len(comparison.failed)} cases have no result:</p><ul>{items}</ul></div>'


def _figure(figure: ComparedFigure) -> str:
    heads = ["setting", "runs", "share" if figure.is_goal else "mean", "95 % interval"]
    heads += [] if figure.is_goal else ["against the first, same seeds"]
    rows = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row_texts(figure, row))}</tr>" for row in figure.rows
    )
    title = f"{'runs with ' if figure.is_goal else ''}{figure.name}"
    cells = "".join(f'<th scope="col">{head}</th>' for head in heads)
    return f"<h2>{escape(title)}</h2>{_chart(figure, title)}<table><tr>{cells}</tr>{rows}</table>"


def _chart(figure: ComparedFigure, title: str) -> str:
    """A point and its interval for each setting, on one axis."""
    rows = [row for row in figure.rows if row.mean is not None]
    if len(rows) < 2 or len(rows) > _MAX_ROWS:
        return ""
    ends = [
        value for row in rows if row.mean for value in (row.mean.estimate, row.mean.low, row.mean.high)
        if value is not None
    ]  # fmt: skip
    low, high = min(ends), max(ends)
    span = (high - low) or abs(high) or 1.0

    def x(value: float) -> float:
        return _LABEL + 10 + (value - low) / span * (_WIDTH - _LABEL - 30)

    marks = []
    for index, row in enumerate(rows):
        assert row.mean is not None
        y = _ROW * index + _ROW / 2
        label = settings_text(row.settings)
        short = label if len(label) <= 44 else f"{label[:43]}…"
        marks.append(f'<text x="{_LABEL}" y="{y + 5:.0f}" text-anchor="end" font-size="13">{escape(short)}</text>')
        if row.mean.low is not None and row.mean.high is not None:
            marks.append(f'<path d="M{x(row.mean.low):.1f} {y:.0f}H{x(row.mean.high):.1f}" stroke-width="2"/>')
        marks.append(f'<circle cx="{x(row.mean.estimate):.1f}" cy="{y:.0f}" r="4" stroke="none"/>')
    height = _ROW * len(rows) + 24
    for value, anchor in ((low, "start"), (high, "end")):
        marks.append(
            f'<text x="{x(value):.1f}" y="{height - 6}" text-anchor="{anchor}" font-size="12">{number(value)}</text>'
        )
    return (
        f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{escape(title)}" fill="currentColor" '
        f'stroke="none"><g stroke="#1f6feb" fill="#1f6feb">{"".join(m for m in marks if not m.startswith("<text"))}</g>'
        f"{''.join(m for m in marks if m.startswith('<text'))}</svg>"
    )
