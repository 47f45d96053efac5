"""Labels for the lids of devices: name, MAC and host key fingerprint, as text and as a QR code, on sheets of labels.

`labels` selects the texts and `sheet_positions` the places, both pure; `draw` makes the PDF with segno and reportlab,
the extra `labels`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from meshctl.errors import InputError
from meshctl.model import Node

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

POINTS_PER_MM = 72 / 25.4
MM_PER_INCH = 25.4
INSTALL_HINT = "install it with: pip install 'meshctl-fleet[labels]' (reportlab and segno)"
NO_KEY = "no host key pinned"
# ISO/IEC 18004: four modules of white around the code
QUIET_ZONE_MODULES = 4
TITLE_FONT, MIN_TITLE_POINTS = "Helvetica-Bold", 5.0
MAX_CODE_SHARE = 0.42
"""Of a label's width: with more, the fingerprint beside the code becomes too small to read."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """A sheet of label paper, in mm: `margin` to the first label's left and top edge, `pitch` from one to the next."""

    page_mm: tuple[float, float]
    columns: int
    rows: int
    label_mm: tuple[float, float]
    margin_mm: tuple[float, float]
    pitch_mm: tuple[float, float]

    @property
    def count(self) -> int:
        return self.columns * self.rows


_LETTER_MM = (8.5 * MM_PER_INCH, 11 * MM_PER_INCH)
_A4_MM = (210.0, 297.0)
# The manufacturers' templates, by their numbers.
SHEETS: Mapping[str, Sheet] = {
    "5160": Sheet(
        _LETTER_MM,
        3,
        10,
        (2.625 * MM_PER_INCH, 1 * MM_PER_INCH),
        (0.1875 * MM_PER_INCH, 0.5 * MM_PER_INCH),
        (2.75 * MM_PER_INCH, 1 * MM_PER_INCH),
    ),
    "L7160": Sheet(_A4_MM, 3, 7, (63.5, 38.1), (7.2, 15.15), (66.04, 38.1)),
}


@dataclass(frozen=True, slots=True)
class DeviceLabel:
    """One label; empty text is left out. `fingerprints` are those of the pinned host keys."""

    name: str
    label: str
    mac: str
    serial: str
    fingerprints: tuple[str, ...]

    @property
    def code_text(self) -> str:
        """The text in the QR code: lines `name NAME`, `mac MAC`, `key SHA256:...`."""
        lines = [f"name {self.name}"]
        lines += [f"mac {self.mac}"] if self.mac else []
        return "\n".join([*lines, *(f"key {each}" for each in self.fingerprints[:1])])


def labels(nodes: Iterable[Node], fingerprints: Callable[[str], tuple[str, ...]]) -> tuple[DeviceLabel, ...]:
    """The labels of these nodes; `fingerprints` gives those of a node's pinned host keys."""
    return tuple(
        DeviceLabel(
            node.name,
            node.label,
            node.mac or next((radio.mac for radio in node.radios if radio.mac), ""),
            node.serial,
            fingerprints(node.name),
        )
        for node in nodes
    )


def sheet_positions(sheet: Sheet, skip: int = 0) -> Iterator[tuple[int, float, float]]:
    """Page (from 0) and top left corner in mm from the page's top left, for each label in turn; the first `skip` labels
    of the first page are already used. Endless."""
    place = skip
    while True:
        page, on_page = divmod(place, sheet.count)
        row, column = divmod(on_page, sheet.columns)
        yield page, sheet.margin_mm[0] + column * sheet.pitch_mm[0], sheet.margin_mm[1] + row * sheet.pitch_mm[1]
        place += 1


def draw(found: tuple[DeviceLabel, ...], sheet: Sheet, *, skip: int = 0, outlines: bool = False) -> bytes:
    """The PDF, the same bytes for the same labels. Raises InputError without the extra, or if `skip` fills a page."""
    try:
        import segno
        from reportlab.pdfgen.canvas import Canvas
    except ImportError as error:
        raise InputError(f"label sheets need {error.name}, which is not installed", hint=INSTALL_HINT) from None
    if not 0 <= skip < sheet.count:
        raise InputError(f"--skip {skip}: expected 0 to {sheet.count - 1}, the labels of a page")
    content = io.BytesIO()
    size = (sheet.page_mm[0] * POINTS_PER_MM, sheet.page_mm[1] * POINTS_PER_MM)
    canvas = Canvas(content, pagesize=size, invariant=1)
    canvas.setTitle("Labels")
    current = 0
    for label, (page, left, top) in zip(found, sheet_positions(sheet, skip), strict=False):
        if page != current:
            canvas.showPage()
            current = page
        code = segno.make(label.code_text, error="m", micro=False)
        _draw_label(canvas, label, [bytes(row) for row in code.matrix], sheet, left, top, outlines=outlines)
    canvas.showPage()
    canvas.save()
    return content.getvalue()


def _draw_label(
    canvas: Canvas,
    label: DeviceLabel,
    modules: list[bytes],
    sheet: Sheet,
    left_mm: float,
    top_mm: float,
    *,
    outlines: bool,
) -> None:
    """One label: the code on the left, the text beside it."""
    width, height = (each * POINTS_PER_MM for each in sheet.label_mm)
    left, bottom = left_mm * POINTS_PER_MM, (sheet.page_mm[1] - top_mm) * POINTS_PER_MM - height
    if outlines:
        canvas.setLineWidth(0.25)
        canvas.roundRect(left, bottom, width, height, 4)
    side = min(height * 0.94, width * MAX_CODE_SHARE)
    edge = height * 0.03
    module = side / (len(modules) + 2 * QUIET_ZONE_MODULES)
    origin = (left + edge + QUIET_ZONE_MODULES * module, bottom + (height + side) / 2)
    for row, line in enumerate(modules):
        y = origin[1] - (row + 1 + QUIET_ZONE_MODULES) * module
        for column, is_dark in enumerate(line):
            if is_dark:
                canvas.rect(origin[0] + column * module, y, module, module, stroke=0, fill=1)
    beside = edge + side
    _draw_text(canvas, label, left + beside, bottom, width - beside - 4, height)


def _draw_text(canvas: Any, label: DeviceLabel, left: float, bottom: float, width: float, height: float) -> None:
    """The label's lines, each as large as fits."""
    key = label.fingerprints[0] if label.fingerprints else NO_KEY
    half = (len(key) + 1) // 2
    halves = (key[:half], key[half:]) if label.fingerprints else (key, "")
    lines = [
        *_title(canvas, label, width, height),
        (label.mac, "Courier", height * 0.13),
        (label.serial, "Helvetica", height * 0.11),
        (halves[0], "Courier", height * 0.1),
        (halves[1], "Courier", height * 0.1),
    ]
    y = bottom + height * 0.92
    for text, font, size in lines:
        if not text:
            continue
        shown = _printable(text)
        fitting = min(size, size * width / max(canvas.stringWidth(shown, font, size), 1))
        y -= size * 1.15
        canvas.setFont(font, fitting)
        canvas.drawString(left, y, shown)


def _title(canvas: Any, label: DeviceLabel, width: float, height: float) -> list[tuple[str, str, float]]:
    """Label and name on one line, or, where that would be too small to read, the label above the name in two parts."""
    size = height * 0.2
    caption = f"{label.label}  {label.name}" if label.label else label.name
    if size * width / max(canvas.stringWidth(_printable(caption), TITLE_FONT, size), 1) >= MIN_TITLE_POINTS:
        return [(caption, TITLE_FONT, size)]
    half = (len(label.name) + 1) // 2
    parts = [(label.name[:half], TITLE_FONT, height * 0.1), (label.name[half:], TITLE_FONT, height * 0.1)]
    return [(label.label, TITLE_FONT, height * 0.12), *parts]


def _printable(text: str) -> str:
    """The text with '?' for characters that the PDF's own fonts lack."""
    return text.encode("latin-1", "replace").decode("latin-1")


def is_printable(label: DeviceLabel) -> bool:
    """Whether a sheet shows all characters of the label's texts."""
    return all(_printable(text) == text for text in (label.name, label.label, label.serial))
