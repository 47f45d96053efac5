"""Files on disk: whole, with their modes, never over what is not ours, never a secret where others can read."""

from __future__ import annotations

import os
import stat
import subprocess
from pathlib import Path

import pytest

from meshctl.errors import InputError
from meshctl.model import Encryption, Fleet, HardwareProfile, Release
from meshctl.render import Rendered, render_fleet
from meshctl.render.imagebuilder import folder_files, image_folders
from meshctl.render.write import write_folder, write_node
from tests.meshctl.render import fleets


def encrypted() -> Fleet:
    return fleets.fleet(meshes=(fleets.mesh(encryption=Encryption.PSK2),))


def rendered() -> Rendered:
    return next(render_fleet(encrypted(), fleets.secrets))


def tree(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {
        path.relative_to(folder).as_posix(): (stat.S_IMODE(path.stat().st_mode), path.read_bytes())
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_exactly_the_files_of_the_node_are_written_with_their_modes(tmp_path: Path) -> None:
    item = rendered()
    folder = write_node(item, tmp_path / "out")
    assert tree(folder) == {file.path: (file.mode, file.content) for file in item.files}
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_folder_modes_do_not_depend_on_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        folder = write_node(rendered(), tmp_path)
    finally:
        os.umask(before)
    modes = {path.relative_to(folder).as_posix(): stat.S_IMODE(path.stat().st_mode) for path in folder.rglob("*/")}
    folders = {name: mode for name, mode in modes.items() if (folder / name).is_dir()}
    assert folders == {"etc": 0o755, "etc/config": 0o755, "etc/dropbear": 0o700, "etc/meshctl": 0o755}


def test_rendering_again_replaces_the_whole_folder(tmp_path: Path) -> None:
    item = rendered()
    folder = write_node(item, tmp_path)
    (folder / "etc/config/stale").write_text("left over")
    write_node(item, tmp_path)
    assert set(tree(folder)) == {file.path for file in item.files}
    assert [path.name for path in tmp_path.iterdir()] == [item.node]


def test_a_folder_not_rendered_by_meshctl_is_never_replaced(tmp_path: Path) -> None:
    item = rendered()
    own = tmp_path / item.node
    own.mkdir()
    (own / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="expected a folder that meshctl rendered"):
        write_node(item, tmp_path)
    assert tree(own) == {"thesis.txt": (stat.S_IMODE((own / "thesis.txt").stat().st_mode), b"years of work")}


def test_a_symlink_or_file_at_the_output_path_is_rejected(tmp_path: Path) -> None:
    item = rendered()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / item.node).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="exists and is not a folder"):
        write_node(item, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_node(item, tmp_path / "file")


def test_a_world_writable_output_folder_is_rejected(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    out.chmod(0o777)
    with pytest.raises(InputError, match="writable by others"):
        write_node(rendered(), out)
    out.chmod(0o1777)
    write_node(rendered(), out)


def test_a_secret_is_not_written_to_a_file_system_without_modes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fat(handle: int, mode: int) -> None:
        os.chmod(handle, 0o755)

    # what a FAT file system does to every mode
    monkeypatch.setattr("meshctl.render.write.os.fchmod", fat)
    with pytest.raises(InputError, match=r"expected a file system that keeps a secret \(mode 0600\), found mode 0755"):
        write_node(rendered(), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_previous_output_intact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    item = rendered()
    folder = write_node(item, tmp_path)
    before = tree(folder)

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("meshctl.render.write.os.fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_node(item, tmp_path)
    assert tree(folder) == before
    assert [path.name for path in tmp_path.iterdir()] == [item.node]


class TestImageBuilder:
    """Overlays, package lists, and the calls."""

    @staticmethod
    def fleet(**changes: str) -> Fleet:
        nodes = [
            fleets.node(name="one"),
            fleets.node(name="two's", packages=("tcpdump",)),
            fleets.node(Release.V24_10, name="three"),
        ]
        return fleets.fleet(*nodes, meshes=(fleets.mesh(encryption=Encryption.PSK2),), **changes)

    def test_image_folders_are_grouped_by_hardware_and_release(self) -> None:
        fleet = self.fleet()
        folders = image_folders(fleet, render_fleet(fleet, fleets.secrets))
        assert [(item.name, [node.node for node in item.overlays]) for item in folders] == [
            ("wpj344-23.05", ["one", "two's"]),
            ("wpj344-24.10", ["three"]),
        ]
        assert folders[0].packages_text.split() == [
            "batctl-default",
            "iw",
            "kmod-batman-adv",
            "tcpdump",
            "wpad-mesh-mbedtls",
            "-wpad-basic-mbedtls",
        ]

    def test_the_build_script_runs_the_expected_make_commands(self, tmp_path: Path) -> None:
        """Run by a real shell, with a `make` that writes down how it was called."""
        profile: HardwareProfile = fleets.hardware(Release.V23_05, package_files=("local.ipk",))
        fleet = fleets.fleet(
            fleets.node(name="one", hardware=profile),
            fleets.node(name="two's", hardware=profile, packages=("tcpdump",)),
            base=str(tmp_path),
        )
        (tmp_path / "local.ipk").write_text("package")
        (item,) = image_folders(fleet, render_fleet(fleet, fleets.secrets))
        folder = write_folder(folder_files(item), tmp_path / "with space" / item.name, marker="build.sh")
        builder = tmp_path / "imagebuilder"
        (builder / "packages").mkdir(parents=True)
        make = tmp_path / "bin/make"
        make.parent.mkdir()
        make.write_text('#!/bin/sh\nfor word; do echo "$word"; done >> calls\n')
        make.chmod(0o755)
        environ = {**os.environ, "PATH": f"{make.parent}:{os.environ['PATH']}"}

        def calls(*nodes: str) -> list[str]:
            subprocess.run(["sh", folder / "build.sh", *nodes], cwd=builder, env=environ, check=True)
            lines = (builder / "calls").read_text().splitlines()
            (builder / "calls").unlink()
            return lines

        second = [
            "image",
            "PROFILE=compex_wpj344-16m",
            "PACKAGES=batctl-default iw kmod-batman-adv tcpdump",
            f"FILES={folder}/files/two's",
            "EXTRA_IMAGE_NAME=two's",
        ]
        assert calls("two's") == second
        assert calls()[5:] == second
        assert (builder / "packages/local.ipk").read_text() == "package"
        assert (folder / "files/one/etc/config/wireless").is_file()
