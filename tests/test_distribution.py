"""What the distribution is called and how documents install it: never by a name that is another project's."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import meshctl
import udp_mesh

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
# `pip install` with options, up to the end of the quoted or bare requirement
INSTALL = re.compile(r"pip install (?:--?[\w-]+(?:[ =][\w./]+)? )*(\"[^\"]+\"|'[^']+'|\S+)")


def documents() -> list[Path]:
    found = [*ROOT.glob("*.md"), ROOT / "Makefile", *ROOT.glob("docs/**/*.md"), *ROOT.glob("scripts/*")]
    for package in ("meshctl", "udp_mesh", "benchmarks"):
        found += (ROOT / package).rglob("*.py")
    return [path for path in found if path.is_file()]


def test_the_distribution_is_named_meshctl_fleet_and_installs_both_commands() -> None:
    assert PROJECT["name"] == "meshctl-fleet"
    assert set(PROJECT["scripts"]) == {"meshctl", "udp-mesh"}


def test_all_versions_are_the_same() -> None:
    assert PROJECT["version"] == meshctl.__version__ == udp_mesh.__version__
    packages = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "udp_mesh").rglob("package.xml"))]
    assert [re.findall("<version>(.*)</version>", text) for text in packages] == [[PROJECT["version"]]] * 2


def test_no_document_installs_another_project_s_package() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}: {found[0]}"
        for path in documents()
        for found in INSTALL.finditer(path.read_text(encoding="utf-8"))
        # "Do not write `pip install meshctl`" is what the guide says
        if re.match(r"[\"']?meshctl(\[|\"|'|$|=|`)", found[1]) and "Do not write" not in _line_of(path, found.start())
    ]
    assert wrong == []


def test_examples_name_a_release_of_this_version() -> None:
    tags = [
        tag
        for name in ("README.md", "docs/lint.md")
        for tag in re.findall(r"(?:@|rev: )v([\d.]+\d)", (ROOT / name).read_text(encoding="utf-8"))
    ]
    assert len(tags) >= 4
    assert set(tags) == {PROJECT["version"]}


def test_the_changelog_has_a_dated_section_for_this_version() -> None:
    headings = re.findall(r"^## \[([^]]+)\](.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0] == ("Unreleased", "")
    version, date = headings[1]
    assert version == PROJECT["version"]
    assert re.fullmatch(r" - \d{4}-\d{2}-\d{2}", date)


def _line_of(path: Path, offset: int) -> str:
    text = path.read_text(encoding="utf-8")
    return text[text.rfind("\n", 0, offset) + 1 : text.find("\n", offset)]
