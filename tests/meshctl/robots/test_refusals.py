"""Whatever prevents a computer from running udp_mesh is reported before anything on it changes."""

from __future__ import annotations

from tests.meshctl.robots.fleets import RobotFleet

_NOTHING = "ls -A /opt /etc/systemd/system"


def test_an_incompatible_computer_is_refused_and_left_unchanged(fleet: RobotFleet) -> None:
    fleet.add("husky1")
    fleet.write()
    before = fleet.shell("husky1", _NOTHING)

    fleet.write(arch="aarch65")
    output = fleet.deploy(exit_code=1)
    assert "husky1: refused: wrong CPU: expected aarch65" in output

    # another interpreter's answers, since not every Python can be installed
    fleet.tool(
        "husky1",
        "python3.8",
        "#!/bin/sh\nprintf 'python=3.8.10\\nimplementation=CPython\\nbits=64\\nlibc=glibc 2.31\\n'\n",
    )
    fleet.write(python="python3.8")
    assert "wrong Python: python3.8 is 3.8.10, expected 3.11 or newer" in fleet.deploy(exit_code=1)
    fleet.write(python="python3.99")
    assert "python3.99 does not run" in fleet.deploy(exit_code=1)

    assert fleet.shell("husky1", _NOTHING) == before


def test_a_full_disk_is_detected_before_and_handled_during_a_deploy(fleet: RobotFleet) -> None:
    fleet.add("husky1", opt_kib=20_000)
    fleet.write()
    output = fleet.deploy(exit_code=1)
    assert "disk full" in output
    assert fleet.shell("husky1", "ls /opt") == "python\n"

    # it looked large enough, and fills up while the packages are unpacked
    fleet.tool("husky1", "df", "#!/bin/sh\necho Filesystem\necho tmpfs 1000000 1 999999 1% /opt\n")
    output = fleet.deploy(exit_code=1)
    assert "husky1: failed" in output
    assert (
        fleet.shell("husky1", "ls -A /opt/udp-mesh/releases /opt/udp-mesh/trees 2>/dev/null | grep -v : || :").strip()
        == ""
    )
    assert fleet.status()["husky1"]["service"]["active"] != "active"


def test_an_unreachable_or_untrusted_robot_does_not_block_the_others(fleet: RobotFleet) -> None:
    for name in ("husky1", "husky2"):
        fleet.add(name)
    fleet.write()
    fleet.machines["husky2"].stop()
    output = fleet.deploy(exit_code=3)
    assert "husky1: done" in output
    assert "husky2: unreachable" in output
    fleet.machines["husky2"].start()
    (fleet.directory / "known_hosts").unlink()
    assert "no host key is pinned" in fleet.deploy("husky2", exit_code=1)
    assert "pinned now" in fleet.meshctl("trust", "--yes")
    output = fleet.deploy()
    assert "husky1: unchanged" in output
    assert "husky2: done: runs " in output
