"""Label sheets: every label lies on its place of the paper, and a scanner reads the code that is drawn there."""

from __future__ import annotations

import base64
import io
import re
import shutil
import sys
from pathlib import Path

import pytest
import zxingcpp
from PIL import Image, ImageDraw
from pypdf import PdfReader
from typer.testing import CliRunner, Result

from meshctl.cli.main import build
from meshctl.device.trust import HostKey
from meshctl.errors import InputError
from meshctl.interchange.label_sheet import (
    MIN_TITLE_POINTS,
    POINTS_PER_MM,
    SHEETS,
    DeviceLabel,
    Sheet,
    draw,
    is_printable,
    labels,
    sheet_positions,
)
from meshctl.inventory import load_fleet
from meshctl.resources import shipped
from tests.meshctl.interchange.devices import SSH_KEY

FINGERPRINT = "SHA256:uNiVztksCsDhcc0u9e8BrrJXVGDuqXGzdRLJJ8Y0wSQ"
DOTS_PER_POINT = 4
MIN_READABLE_POINTS = 6.0
_RECTANGLE = re.compile(r"n ([-\d.]+) ([-\d.]+) ([-\d.]+) ([-\d.]+) re f")


def label(number: int) -> DeviceLabel:
    return DeviceLabel(f"b{number:02}", f"B{number}", f"02:00:5e:00:00:{number:02x}", f"SN-{number}", (FINGERPRINT,))


def drawn(content: bytes, sheet: Sheet) -> list[Image.Image]:
    """Each page's filled rectangles as a picture, from the PDF's own drawing operations."""
    pages = []
    for page in PdfReader(io.BytesIO(content)).pages:
        width, height = (float(each) for each in page.mediabox[2:])
        assert width == pytest.approx(sheet.page_mm[0] * POINTS_PER_MM, abs=0.01)
        assert height == pytest.approx(sheet.page_mm[1] * POINTS_PER_MM, abs=0.01)
        picture = Image.new("L", (int(width * DOTS_PER_POINT), int(height * DOTS_PER_POINT)), 255)
        pen = ImageDraw.Draw(picture)
        operations = page.get_contents()
        assert operations is not None
        for found in _RECTANGLE.findall(operations.get_data().decode("latin-1")):
            x, y, w, h = (float(each) * DOTS_PER_POINT for each in found)
            bottom = picture.height - y
            pen.rectangle((x, bottom - h, x + w, bottom), fill=0)
        pages.append(picture)
    return pages


@pytest.mark.parametrize("paper", SHEETS)
def test_every_code_is_read_inside_its_label(paper: str) -> None:
    sheet = SHEETS[paper]
    skip = 2
    found = tuple(label(number) for number in range(1, sheet.count + 2))
    content = draw(found, sheet, skip=skip)
    pages = drawn(content, sheet)
    assert len(pages) == 2
    read = []
    for number, picture in enumerate(pages):
        places = [place for _, place in zip(range(skip + len(found)), sheet_positions(sheet), strict=False)]
        for page, left, top in places:
            if page != number:
                continue
            scale = POINTS_PER_MM * DOTS_PER_POINT
            box = (left * scale, top * scale, (left + sheet.label_mm[0]) * scale, (top + sheet.label_mm[1]) * scale)
            codes = zxingcpp.read_barcodes(picture.crop(box))
            read += [code.text for code in codes]
    assert read == [each.code_text for each in found]
    assert read[0] == f"name b01\nmac 02:00:5e:00:00:01\nkey {FINGERPRINT}"


def test_the_text_has_name_label_mac_and_fingerprint() -> None:
    text = PdfReader(io.BytesIO(draw((label(7),), SHEETS["L7160"]))).pages[0].extract_text()
    for word in ("B7", "b07", "02:00:5e:00:00:07", "SN-7"):
        assert word in text
    assert FINGERPRINT in text.replace("\n", "")


@pytest.mark.parametrize("paper", SHEETS)
def test_a_name_of_63_characters_can_be_read_and_leaves_room_for_the_rest(paper: str) -> None:
    name = "a-beacon-in-the-northern-adit-of-level-7-" + "x" * 22
    found = DeviceLabel(name, "B7", "02:00:5e:00:00:07", "SN-7", (FINGERPRINT,))
    (page,) = PdfReader(io.BytesIO(draw((found,), SHEETS[paper]))).pages
    assert name in page.extract_text().replace("\n", "")
    operations = page.get_contents()
    assert operations is not None
    text = operations.get_data().decode("latin-1")
    sizes = [float(size) for size, line in re.findall(r"/F\d+ ([\d.]+) Tf [^/]*?\((.*?)\) Tj", text) if line in name]
    assert len(sizes) == 2
    assert min(sizes) >= MIN_TITLE_POINTS
    lowest = min(float(y) for y in re.findall(r"1 0 0 1 [\d.]+ ([\d.]+) Tm", text))
    sheet = SHEETS[paper]
    assert lowest > (sheet.page_mm[1] - sheet.margin_mm[1] - sheet.label_mm[1]) * POINTS_PER_MM


@pytest.mark.parametrize(("text", "is_shown"), [("Höhle 3", True), ("Łódź 1", False), ("坑道 4", False)])
def test_labels_that_the_fonts_lack_characters_for_are_known(text: str, is_shown: bool) -> None:
    assert is_printable(DeviceLabel("b07", text, "", "", ())) == is_shown


@pytest.mark.parametrize("paper", SHEETS)
def test_both_lines_of_the_fingerprint_are_of_one_size_that_can_be_read(paper: str) -> None:
    operations = PdfReader(io.BytesIO(draw((label(7),), SHEETS[paper]))).pages[0].get_contents()
    assert operations is not None
    text = operations.get_data().decode("latin-1")
    sizes = {line: float(size) for size, line in re.findall(r"/F\d+ ([\d.]+) Tf [^/]*?\((.*?)\) Tj", text)}
    found = [size for line, size in sizes.items() if line in FINGERPRINT]
    assert len(found) == 2
    assert found[0] == found[1] >= MIN_READABLE_POINTS


@pytest.mark.parametrize("paper", SHEETS)
def test_labels_stay_on_the_paper_and_do_not_overlap(paper: str) -> None:
    sheet = SHEETS[paper]
    places = [(left, top) for (_, left, top), _ in zip(sheet_positions(sheet), range(sheet.count), strict=False)]
    assert all(left + sheet.label_mm[0] <= sheet.page_mm[0] for left, _ in places)
    assert all(top + sheet.label_mm[1] <= sheet.page_mm[1] for _, top in places)
    assert sheet.pitch_mm[0] >= sheet.label_mm[0]
    assert sheet.pitch_mm[1] >= sheet.label_mm[1]
    assert len(set(places)) == sheet.count


def test_the_same_labels_give_the_same_bytes_and_skip_is_bounded() -> None:
    assert draw((label(1),), SHEETS["5160"]) == draw((label(1),), SHEETS["5160"])
    with pytest.raises(InputError, match="--skip 30: expected 0 to 29"):
        draw((label(1),), SHEETS["5160"], skip=30)


def test_a_node_without_a_pinned_key_gets_a_label_that_says_so() -> None:
    fleet = load_fleet(shipped("inventory") / "subt-final")
    (found,) = labels([fleet.nodes["husky1-b01"]], lambda name: ())
    assert found.code_text == "name husky1-b01"
    text = PdfReader(io.BytesIO(draw((found,), SHEETS["L7160"]))).pages[0].extract_text()
    assert "no host key pinned" in text


def run(*words: str) -> Result:
    return CliRunner().invoke(build("inventory"), ["inventory", "export", *words])


def test_the_command_takes_the_pinned_fingerprints(tmp_path: Path) -> None:
    fleet = Path(shutil.copytree(shipped("inventory") / "subt-final", tmp_path / "fleet"))
    (fleet / "known_hosts").write_text(f"husky1-b01 {' '.join(SSH_KEY.split()[:2])}\n")
    out = tmp_path / "lids.pdf"
    done = run("husky1-b0[12]", "-i", str(fleet), "--format", "labels", "--sheet", "5160", "--out", str(out))
    assert done.exit_code == 0, done.output
    assert "without a host key: husky1-b02" in done.output
    (picture,) = drawn(out.read_bytes(), SHEETS["5160"])
    texts = sorted(code.text for code in zxingcpp.read_barcodes(picture))
    key = HostKey("ssh-ed25519", base64.b64decode(SSH_KEY.split()[1]))
    assert texts == [f"name husky1-b01\nkey {key.fingerprint}", "name husky1-b02"]


def test_wrong_paper_and_a_missing_extra_say_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    inventory = str(shipped("inventory") / "subt-final")
    wrong = run("-i", inventory, "--format", "labels", "--sheet", "5161", "--out", str(tmp_path / "a.pdf"))
    assert wrong.exit_code == 2
    assert "expected one of 5160, L7160" in wrong.output
    for option in (("--sheet", "5160"), ("--skip", "2"), ("--outlines",)):
        other = run("-i", inventory, "--format", "csv", *option)
        assert other.exit_code == 2
        assert f"{option[0]}: --format csv prints no labels" in other.output
    monkeypatch.setitem(sys.modules, "segno", None)
    missing = run("-i", inventory, "--format", "labels", "--out", str(tmp_path / "a.pdf"))
    assert missing.exit_code == 2
    assert "pip install 'meshctl-fleet[labels]'" in missing.output
    assert list(tmp_path.iterdir()) == []
