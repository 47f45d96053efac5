"""The sources of the machine's packages, on Debian and other distributions."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from meshlab.errors import LabError
from meshlab.qemu import apt

BOOKWORM = 'PRETTY_NAME="Debian GNU/Linux 12 (bookworm)"\nVERSION_CODENAME=bookworm\n'
NOBLE = 'PRETTY_NAME="Ubuntu 24.04.1 LTS"\nVERSION_CODENAME=noble\nUBUNTU_CODENAME=noble\n'


def release(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "os-release"
    file.write_text(text)
    return file


def test_bookworm_uses_its_own_apt_sources(tmp_path: Path) -> None:
    assert apt.sources(tmp_path / "cache", {}, release(tmp_path, BOOKWORM)) == {}


def test_other_distributions_use_only_a_bookworm_source_list(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apt, "KEYRING", release(tmp_path, NOBLE))
    options = apt.sources(tmp_path / "cache", {}, release(tmp_path, NOBLE))
    listed = Path(options["Dir::Etc::sourcelist"]).read_text()
    assert listed == f"deb [arch=amd64 signed-by={apt.KEYRING}] {apt.MIRROR} bookworm main\n"
    assert options["Dir::Etc::sourceparts"] == "-"
    # check the options with apt itself
    (tmp_path / "work").mkdir()
    shown = apt.Apt(tmp_path / "work", options).get(tmp_path, "-qq", "indextargets", "--format", "$(METAKEY)")
    assert {line.split("/")[0] for line in shown.splitlines()} <= {"main"}


def test_a_configured_mirror_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apt, "KEYRING", release(tmp_path, NOBLE))
    options = apt.sources(
        tmp_path / "cache",
        {apt.MIRROR_VARIABLE: "http://mirror.example/debian"},
        release(tmp_path, BOOKWORM),
    )
    assert "http://mirror.example/debian bookworm main" in Path(options["Dir::Etc::sourcelist"]).read_text()


def test_a_missing_keyring_is_rejected_with_a_hint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apt, "KEYRING", tmp_path / "nothing")
    with pytest.raises(LabError, match=r"Ubuntu 24\.04\.1 LTS has no .*nothing") as caught:
        apt.sources(tmp_path / "cache", {}, release(tmp_path, NOBLE))
    assert "setup-lab" in caught.value.hint


def test_no_link_of_an_unpacked_root_leads_to_the_host(tmp_path: Path) -> None:
    for folder in ("bin", "sbin", "lib64", "lib/x86_64-linux-gnu", "etc"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "bin/ip").write_text("the root's")
    (tmp_path / "lib/x86_64-linux-gnu/loader").write_text("the root's")
    # as in the packages iproute2 and libc6
    links = {"sbin/ip": "/bin/ip", "lib64/loader": "/lib/x86_64-linux-gnu/loader", "etc/sh": "../bin/ip"}
    for link, target in {**links, "lib64/more": "/etc", "etc/missing": "/bin/missing"}.items():
        (tmp_path / link).symlink_to(target)
    apt.keep_links_inside(tmp_path)
    assert {(tmp_path / link).read_text() for link in links} == {"the root's"}
    assert (tmp_path / "lib64/more").resolve() == tmp_path / "etc"
    assert (tmp_path / "etc/missing").resolve() == tmp_path / "bin/missing"
    assert (tmp_path / "etc/sh").readlink() == Path("../bin/ip")


def test_setup_lab_fails_with_an_error_without_apt(tmp_path: Path) -> None:
    script = Path(__file__).parents[3] / "scripts" / "setup-lab"
    shell = shutil.which("sh")
    assert shell is not None
    done = subprocess.run((shell, script), env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "expected Debian or Ubuntu, found no apt-get" in done.stderr
