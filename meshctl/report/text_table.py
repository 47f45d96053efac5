"""Rows of text -> aligned lines; on a narrow terminal, some columns are left out and named below."""

from __future__ import annotations

from collections.abc import Sequence

from meshctl.report.line_wrap import wrap

_GAP = "  "


def lines(
    heading: Sequence[str], rows: Sequence[Sequence[str]], width: int | None = None, *, leave_out: Sequence[str] = ()
) -> list[str]:
    """The heading and the rows. Until they fit into `width`, the columns of `leave_out` are left out in that order,
    those without any value first; no cell is shortened."""
    widths = [max(len(line[at]) for line in (heading, *rows)) for at in range(len(heading))]
    rank = sorted(leave_out, key=lambda name: any(row[list(heading).index(name)] != "-" for row in rows))
    missing: list[str] = []

    def fits(without: Sequence[str]) -> bool:
        shown = [room for name, room in zip(heading, widths, strict=True) if name not in without]
        return width is None or sum(shown) + len(_GAP) * (len(shown) - 1) <= width

    while rank and not fits(missing):
        missing.append(rank.pop(0))
    for name in tuple(reversed(missing)):
        # a wide column that was left out later may have made room
        if fits([other for other in missing if other != name]):
            missing.remove(name)
    kept = [at for at, name in enumerate(heading) if name not in missing]
    drawn = [_GAP.join(line[at].ljust(widths[at]) for at in kept).rstrip() for line in (heading, *rows)]
    if missing:
        left_out = ", ".join(name.lower() for name in heading if name in missing)
        drawn += wrap(f"columns not shown: {left_out} (use --json)", width)
    return drawn
