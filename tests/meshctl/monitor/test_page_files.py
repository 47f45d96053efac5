"""The page's files: no inline code, no markup from text, joined without conflicts; the pinned files of others."""

from __future__ import annotations

import base64
import gzip
import json
import re
from collections import Counter
from pathlib import Path

import pytest

from meshctl.monitor.frame import Frame
from meshctl.monitor.page import ASSETS, PageRecording, joined_modules, modules, single_file
from tests.test_structure import MAX_LINES

OWN = sorted(ASSETS.glob("*.js"))
ROOT = Path(__file__).resolve().parents[3]


def test_the_page_has_no_inline_script_style_or_handler() -> None:
    html = (ASSETS / "index.html").read_text(encoding="utf-8")
    assert re.findall(r"<script(?![^>]*\bsrc=)|<style|\bstyle=|\son\w+=|javascript:", html) == []
    # from this server alone
    assert re.findall(r'(?:src|href)="(?!assets/|#)[^"]*"', html) == []
    for name in re.findall(r'(?:src|href)="assets/([^"]+)"', html):
        assert (ASSETS / name).is_file(), name


@pytest.mark.parametrize("file", OWN, ids=lambda file: file.name)
def test_no_module_makes_markup_or_code_of_text(file: Path) -> None:
    banned = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|setHTML|DOMParser|cookie"
    assert re.findall(banned, file.read_text(encoding="utf-8")) == []


def test_every_module_is_reached_and_no_two_define_the_same_name() -> None:
    assert sorted(modules()) == [file.name for file in OWN]
    assert modules()[-1] == "main.js"
    found = re.findall(r"^(?:export )?(?:async )?(?:function|const|let|class) (\w+)", joined_modules(), re.MULTILINE)
    assert [name for name, count in Counter(found).items() if count > 1] == []
    assert not re.search(r"^(?:import|export)\b", joined_modules(), re.MULTILINE)


@pytest.mark.parametrize("file", OWN, ids=lambda file: file.name)
def test_modules_stay_short(file: Path) -> None:
    assert len(file.read_text(encoding="utf-8").splitlines()) <= MAX_LINES


def test_colors_of_classes_are_those_of_okabe_and_ito() -> None:
    css = (ASSETS / "style.css").read_text(encoding="utf-8").lower()
    for color in ("#009e73", "#e69f00", "#d55e00", "#56b4e9", "#cc79a7", "#0072b2"):
        assert color in css


def test_a_recording_cannot_leave_its_element() -> None:
    text = "".join(single_file(PageRecording({"meta": {"fleet": "</script><script>alert(1)</script>"}})))
    assert "alert(1)" not in text
    assert text.count("<script") == text.count("</script>") == 7
    assert "default-src 'none'" in text
    assert "src=" not in re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)


def test_frames_are_in_parts_which_hold_them_all() -> None:
    frames = [Frame(number, json.dumps({"time_s": number, "padding": "x" * 400_000})) for number in range(7)]
    text = "".join(single_file(PageRecording({"meta": {}}, [{"node": "a"}, {"node": "b"}], frames)))
    parts = [json.loads(unpacked(one)) for one in re.findall(r'class="frames">([^<]*)<', text)]
    assert [frame["time_s"] for part in parts for frame in part] == list(range(7))
    (rest,) = re.findall(r'id="recording">([^<]*)<', text)
    values = json.loads(unpacked(rest))
    assert values["frames"] == [len(part) for part in parts] == [2, 2, 2, 1]
    assert values["times_s"] == list(range(7))
    assert values["report"] == [{"node": "a"}, {"node": "b"}]


def unpacked(text: str) -> bytes:
    return gzip.decompress(base64.b64decode(text))


def test_files_of_others_are_pinned_by_version_and_hash() -> None:
    pinned = json.loads((ROOT / "scripts/page-assets/package-lock.json").read_text())["packages"]
    licenses = (ASSETS / "vendor/LICENSES.txt").read_text(encoding="utf-8")
    for name, package in pinned.items():
        if name:
            assert package["integrity"].startswith("sha512-")
            assert f"{name.removeprefix('node_modules/')} {package['version']}" in licenses
