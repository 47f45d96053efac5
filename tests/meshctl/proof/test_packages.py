"""Devices whose images lack what a mesh needs, one of them in its first boot: packages, then files, then a mesh."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshlab.images import opkg_package
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("rigs")]

PACKAGES = {"kmod-batman-adv": (), "batctl-default": ("kmod-batman-adv",)}
# As the kernel shows it while / is in memory (fstools, overlay.c); the shell that mounts it, and what the node runs
# already, stand below it and see no difference. It goes when the file in the node's directory goes.
FIRST_BOOT = """
busybox=/rom/lab/genuine/busybox
$busybox mount -t tmpfs overlayfs:/tmp/root /
(while [ -e /lab/node/first-boot ]; do $busybox sleep 0.1; done; $busybox umount /) >/dev/null 2>&1 </dev/null &
"""


def files(directory: Path) -> str:
    """The package files, as a line of the hardware profile."""
    directory.mkdir(parents=True)
    for name, needs in PACKAGES.items():
        (directory / f"{name}_1_mips_24kc.ipk").write_bytes(opkg_package(name, "1", {}, depends=needs))
    return f"    package_files: [{', '.join(f'{name}_1_mips_24kc.ipk' for name in PACKAGES)}]"


def test_bootstrap_waits_for_the_flash_and_installs_packages_first(tmp_path: Path) -> None:
    line = files(tmp_path / "rig")
    with Rig(tmp_path / "rig", 1, firmware=dict.fromkeys(("a", "b", "split"), line), packages=()) as rig:
        rig.wait_all_up()
        mark = rig.fleet.directory / "nodes" / "n001" / "first-boot"
        mark.touch()
        rig.fleet.node("n001").exec(FIRST_BOOT)
        with rig.start("bootstrap", "a", "--yes") as process:
            assert process.stdout is not None
            said = []
            for text in process.stdout:
                said.append(text)
                if "waiting until its first boot" in text:
                    # nothing is written to a node whose flash would lose it
                    assert not {"n001: stage\n", "n001: apply\n"} & set(said)
                    mark.unlink()
            assert process.stderr is not None
            stderr = process.stderr.read()
        assert process.returncode == 0, "".join(said) + stderr
        assert "n001: first boot\n" in said
        for name in ("base", "n001"):
            steps = [text.split(": ")[1].strip() for text in said if text.startswith(f"{name}: ")]
            # packages are uploaded and staged step by step, files with one command
            assert [step for step in steps if step in ("packages", "stage", "apply", "prove")] == [
                *("packages", "stage", "apply", "prove"),
                *("apply", "prove"),
            ]
            node = rig.fleet.node(name)
            assert "kmod-batman-adv - 1" in node.exec("opkg list-installed").stdout
            # netifd had started without it
            assert '"batadv"' in node.exec("ubus call network get_proto_handlers").stdout
        assert rig.meshctl("provision", "a", "--check", "--json").verdicts == {"base": "same", "n001": "same"}


def test_a_failed_package_installation_leaves_the_node_unchanged(tmp_path: Path) -> None:
    line = files(tmp_path / "rig")
    (tmp_path / "rig" / "batctl-default_1_mips_24kc.ipk").write_bytes(
        opkg_package("batctl-default", "1", {}, depends=("absent",))
    )
    with Rig(tmp_path / "rig", 1, firmware=dict.fromkeys(("a", "b", "split"), line), packages=()) as rig:
        rig.wait_all_up()
        node = rig.fleet.node("n001")
        before = node.exec("opkg list-installed; cat /etc/config/*").stdout
        ended = rig.meshctl("bootstrap", "a", "n001", "--yes", "--json")
        assert ended.results == {"n001": "rolled back"}, ended.out + ended.err
        assert node.exec("opkg list-installed; cat /etc/config/*").stdout == before


def test_packages_are_uploaded_again_to_a_node_that_lost_its_power_before_they_were_armed(tmp_path: Path) -> None:
    line = files(tmp_path / "rig")
    with Rig(tmp_path / "rig", 1, firmware=dict.fromkeys(("a", "b", "split"), line), packages=()) as rig:
        rig.wait_all_up()
        # while it reads the package files, which are in its memory
        rig.fleet.inject_fault("n001", "power-cut@tar -xzOf")
        ended = rig.meshctl("bootstrap", "a", "n001", "--yes", "--json")
        assert ended.results == {"n001": "done"}, ended.out + ended.err
        assert "kmod-batman-adv - 1" in rig.fleet.node("n001").exec("opkg list-installed").stdout
