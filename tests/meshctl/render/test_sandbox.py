"""Templates that come with an inventory are bounded in time, memory, output and where they are read from."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.diagnostics import InvalidInput
from meshctl.file_access import VARIABLE, Boundary
from meshctl.model import OperatorParts
from meshctl.render import sandbox
from meshctl.render.node import render_node
from meshctl.render.rendered import Rendered
from meshctl.render.templates import Templates
from meshctl.resources import shipped
from tests.meshctl.render import fleets

NAME = "husky1-front"
# which of both comes first depends on the machine
MEMORY = "exceeds 512 MiB of memory|exceeds 1 s of CPU time"
GOOD = "config system\n\toption hostname {{ intent.hostname | uci }}\n"


def write(folder: Path, text: str, path: str = "common/etc/config/system.j2") -> Path:
    template = folder / "templates" / path
    template.parent.mkdir(parents=True, exist_ok=True)
    template.write_text(text, encoding="utf-8")
    return template


def render(folder: Path, templates: Templates | None = None) -> Rendered:
    return render_node(fleets.fleet(base=str(folder)), NAME, fleets.secrets, templates)


def quick(folder: Path) -> Templates:
    templates = Templates((folder / "templates", shipped("templates")))
    templates._bounded = sandbox.SandboxRenderer(cpu_s=1, memory_bytes=512 << 20, wait_s=60)
    return templates


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("config x {{ ('A' * 10**10) | uci }}\n", MEMORY),
        ("config x {{ ('%9999999999d' % 1) | uci }}\n", f"OverflowError|ValueError|{MEMORY}"),
        ("config x {{ 'a'.center(10**10) | uci }}\n", MEMORY),
        ("{% set n = namespace(x='ab') %}{% for i in range(99) %}{% set n.x = n.x ~ n.x %}{% endfor %}", MEMORY),
        (
            "{% for a in range(99999) %}{% for b in range(99999) %}{% for c in range(99999) %}"
            "{% endfor %}{% endfor %}{% endfor %}",
            "the template exceeds 1 s of CPU time",
        ),
        ("config x {{ (9**(9**9)) | uci }}\n", "the template exceeds 1 s of CPU time"),
        (
            "{% for i in range(99999) %}{{ ('A' * 99) | uci }}{% endfor %}",
            "the template's output of .* characters exceeds",
        ),
        ("{% include 'common/etc/config/system.j2' %}", "the template includes itself, or is nested too deeply"),
    ],
)
def test_a_template_that_exceeds_its_limits_is_rejected(tmp_path: Path, text: str, words: str) -> None:
    source = write(tmp_path, text)
    templates = quick(tmp_path)
    with pytest.raises(InvalidInput) as caught:
        render(tmp_path, templates)
    (finding,) = caught.value.diagnostics
    assert finding.position.file == str(source)
    assert re.search(words, str(finding))
    # and the others are rendered as if nothing had been
    write(tmp_path / "other", GOOD)
    others = quick(tmp_path / "other")
    others._bounded = templates._bounded
    assert render(tmp_path / "other", others).package("system")


def test_a_template_that_is_not_text_is_reported_with_the_byte(tmp_path: Path) -> None:
    write(tmp_path, "").write_bytes(b"config \xe8")
    with pytest.raises(InvalidInput) as caught:
        render(tmp_path)
    assert "expected UTF-8 text, found byte 0xe8 at offset 7" in str(caught.value)


def test_no_python_file_of_the_inventory_is_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`python -m` imports from the current directory first, and lint runs in the directory of a pull request."""
    write(tmp_path, GOOD)
    for name in ("json", "jinja2", "meshctl"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(7)")
    monkeypatch.chdir(tmp_path)
    assert "option hostname" in render(tmp_path).masked_text


def test_shipped_templates_start_no_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("subprocess.Popen", None)
    assert render(tmp_path)


def test_a_rendering_process_that_fails_to_start_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, GOOD)
    monkeypatch.setattr("sys.executable", "/bin/false")
    with pytest.raises(InvalidInput, match="the rendering process ended with status 1"):
        render(tmp_path)


def test_symlinks_and_folders_outside_the_tree_and_pipes_are_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = tmp_path / "fleet"
    secret = tmp_path / "token"
    secret.write_text("HUNTER2\n", encoding="utf-8")
    place = write(fleet, GOOD)
    place.unlink()
    place.symlink_to(secret)
    with pytest.raises(InvalidInput, match="outside the inventory's tree") as caught:
        render(fleet)
    assert "HUNTER2" not in str(caught.value)
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    with pytest.raises(InvalidInput, match="output is not UCI"):
        render(fleet)
    monkeypatch.delenv(VARIABLE)
    place.unlink()
    os.mkfifo(place)
    with pytest.raises(InvalidInput, match="a pipe, socket or device"):
        render(fleet)
    place.unlink()
    write(fleet, "{% include 'common/etc/config/_part.j2' %}")
    (place.parent / "_part.j2").symlink_to(secret)
    with pytest.raises(InvalidInput, match="outside the inventory's tree"):
        render(fleet)
    elsewhere = tmp_path / "parts"
    elsewhere.mkdir()
    mesh = fleets.mesh(operator_parts=replace(OperatorParts(), templates="../parts", base=str(fleet)))
    with pytest.raises(InvalidInput, match="outside the inventory's tree"):
        render_node(fleets.fleet(meshes=(mesh,), base=str(fleet)), NAME, fleets.secrets)


def test_the_allowed_tree_is_the_git_work_tree_without_the_git_directory(tmp_path: Path) -> None:
    (tmp_path / "repository/.git").mkdir(parents=True)
    (tmp_path / "repository/fleets/a").mkdir(parents=True)
    boundary = Boundary.of(tmp_path / "repository/fleets/a", {})
    assert boundary.refusal(tmp_path / "repository/common.yaml") == ""
    assert "git" in boundary.refusal(tmp_path / "repository/.git/config")
    assert "outside" in boundary.refusal(tmp_path / "other.yaml")
    assert "outside" in Boundary.of(tmp_path / "plain", {}).refusal(tmp_path / "repository/common.yaml")
    assert boundary.refusal(Path("/dev/zero")).startswith("outside")
