"""A site's directory: what may be unpacked there, who may hold its lock, what is kept and what is deleted."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

import pytest

from meshctl.archive import TarMember, tar_of
from meshctl.errors import InputError
from meshctl.fleet.process import process_of, this_process
from meshctl.sites.runs import MAX_RUNS, PREPARED_S, SiteBusy, SiteDirectory, closing, replace_text, write_json

_RUN = "0123456789abcdef"


@pytest.fixture
def site(tmp_path: Path) -> SiteDirectory:
    return SiteDirectory.of("mines/north", {"XDG_STATE_HOME": str(tmp_path)})


@pytest.mark.parametrize("name", ["", "north", "mines/north/x", "../north", "mines/..", "mines/", "mi nes/north", "/"])
def test_a_site_is_named_by_its_fleet_and_its_name(name: str) -> None:
    with pytest.raises(InputError, match="expected FLEET/SITE"):
        SiteDirectory.of(name, {"HOME": "/root"})


@pytest.mark.parametrize("run", ["", "..", "../../etc", "0123456789abcde", "0123456789ABCDEF", "0123456789abcdef/x"])
def test_a_run_is_named_by_hexadecimal_digits(site: SiteDirectory, run: str) -> None:
    with pytest.raises(InputError, match="expected the id of a run"):
        site.run(run)


def test_a_part_is_unpacked_once(site: SiteDirectory) -> None:
    archive = tar_of([TarMember("fleet.yaml", b"a"), TarMember("x/secrets.yaml", b"b", 0o600)])
    run = site.run(_RUN)
    run.create(archive, {})
    assert (run.inventory / "fleet.yaml").read_bytes() == b"a"
    assert (run.inventory / "x/secrets.yaml").stat().st_mode & 0o077 == 0
    assert run.inventory.stat().st_mode & 0o077 == 0
    with pytest.raises(InputError, match="at this site already"):
        run.create(archive, {})


@pytest.mark.parametrize(
    "member",
    [
        TarMember("../outside", b"x"),
        TarMember("/etc/outside", b"x"),
        TarMember("a/../../outside", b"x"),
        TarMember("link", link_to="/etc/passwd"),
        TarMember("folder", is_directory=True),
    ],
)
def test_an_archive_cannot_reach_out_of_its_run(site: SiteDirectory, tmp_path: Path, member: TarMember) -> None:
    run = site.run(_RUN)
    with pytest.raises(InputError, match="cannot be unpacked"):
        run.create(tar_of([TarMember("fleet.yaml", b"a"), member]), {})
    assert not run.path.exists()
    assert list(tmp_path.rglob("outside")) == []


def test_an_image_stays_for_its_run_when_the_others_are_cleaned_up(site: SiteDirectory) -> None:
    image = site.image("c" * 64)
    image.parent.mkdir(parents=True)
    image.write_bytes(b"image")
    run = site.run(_RUN)
    run.create(tar_of([]), {"firmware/box/box.bin": image})
    image.unlink()
    assert (run.inventory / "firmware/box/box.bin").read_bytes() == b"image"


def test_only_one_run_holds_the_lock(site: SiteDirectory) -> None:
    holder = {"run": _RUN, "operator": "alice@laptop", "command": "provision"}
    with closing(site.lock(holder)), pytest.raises(SiteBusy, match=f"run {_RUN} of alice@laptop"):
        site.lock({"run": "f" * 16, "operator": "bob@desk", "command": "provision"})
    with closing(site.lock(holder)):
        pass


def test_the_lock_outlives_the_process_that_took_it(site: SiteDirectory) -> None:
    lock = site.lock({"run": _RUN, "operator": "alice@laptop", "command": "provision"})
    with subprocess.Popen(["sleep", "60"], pass_fds=(lock,)) as child:
        os.close(lock)
        try:
            with pytest.raises(SiteBusy):
                site.lock({})
        finally:
            child.kill()
    with closing(site.lock({})):
        pass


def test_a_run_is_interrupted_once_its_processes_are_gone(site: SiteDirectory) -> None:
    run = site.run(_RUN)
    run.create(tar_of([TarMember("secrets.yaml", b"secret")]), {})
    assert run.state().state == "prepared"
    write_json(run.order, {"operator": "alice@laptop", "command": "provision"})
    run.process.write_text(f"{this_process()}\n")
    assert run.state().state == "in progress"
    with subprocess.Popen(["sleep", "60"]) as child:
        run.process.write_text(f"{process_of(child.pid)}\n")
        assert run.state().state == "in progress"
        child.kill()
    assert run.state().state == "interrupted"
    site.clean()
    assert not run.inventory.exists()
    write_json(run.over, {"exit": 0})
    assert run.state().state == "over"


def test_a_run_is_never_without_a_process_while_its_files_are_written(site: SiteDirectory) -> None:
    run = site.run(_RUN)
    run.path.mkdir(parents=True)
    replace_text(run.process, f"{this_process()}\n")
    with run.process.open() as reader:
        replace_text(run.process, this_process().rpartition(":")[0] + ":0\n")
        assert reader.read() == f"{this_process()}\n", "a reader found a part"
    assert not run.is_alive()
    # the runner names itself, too, whichever of both is written first
    replace_text(run.processes, f"{this_process()}\n")
    assert run.is_alive()


def test_a_process_that_had_ended_before_it_was_named_is_not_alive(site: SiteDirectory) -> None:
    run = site.run(_RUN)
    run.create(tar_of([]), {})
    with subprocess.Popen(["true"]) as child:
        pass
    run.process.write_text(f"{process_of(child.pid)}\n")
    assert not run.is_alive()


def test_plans_that_were_not_ordered_are_deleted_after_an_hour(site: SiteDirectory) -> None:
    old, new = site.run("0" * 16), site.run("1" * 16)
    for run in (old, new):
        run.create(tar_of([]), {})
    before_s = time.time() - PREPARED_S - 1
    os.utime(old.path, (before_s, before_s))
    site.clean()
    assert (old.path.exists(), new.path.exists()) == (False, True)


def test_the_ids_of_deleted_runs_are_kept(site: SiteDirectory) -> None:
    for number in range(MAX_RUNS + 1):
        run = site.run(f"{number:016x}")
        run.create(tar_of([]), {})
        write_json(run.order, {"operator": "alice@laptop", "command": "provision"})
        write_json(run.over, {"exit": 0})
        os.utime(run.order, (number, number))
    site.clean()
    assert not site.run("0" * 16).path.exists()
    assert site.has_forgotten("0" * 16)
    assert not site.has_forgotten(f"{1:016x}")
    assert len(site.runs()) == MAX_RUNS


def test_events_are_read_by_whole_lines(site: SiteDirectory) -> None:
    run = site.run(_RUN)
    run.create(tar_of([]), {})
    assert run.new_events(0, 100) == b""
    run.events.write_bytes(b'{"event": "step"}\n{"event": "fin')
    assert run.new_events(0, 100) == b'{"event": "step"}\n'
    assert run.new_events(18, 100) == b""


def test_the_workers_key_is_made_once_and_its_own(site: SiteDirectory) -> None:
    public_key = site.install(["ssh-ed25519 AAAA alice"])
    assert site.key.stat().st_mode & 0o077 == 0
    assert site.install(["ssh-ed25519 AAAA bob"]) == public_key
    assert site.operators() == "ssh-ed25519 AAAA bob\n"
    shown = subprocess.run(["ssh-keygen", "-y", "-f", str(site.key)], capture_output=True, text=True, check=True)
    assert shown.stdout.split()[:2] == public_key.split()[:2]
