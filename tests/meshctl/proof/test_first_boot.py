"""A change during the first boot after a flash: the next boot would unpack sysupgrade's archive over it."""

from __future__ import annotations

import pytest

from meshlab.errors import LabError
from meshlab.fleet import VirtualNode
from tests.meshctl.proof.rig import Rig
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("fleet")]

# What a flash that keeps the configuration leaves, and an init script before the last one that takes its time.
KEPT = """
mkdir -p /tmp/kept && cp -a /etc /tmp/kept/
cat >/tmp/kept/etc/init.d/slow <<'END'
#!/bin/sh /etc/rc.common
START=94
boot() { while [ -e /lab/node/flash/slow ]; do sleep 1; done; }
END
chmod 755 /tmp/kept/etc/init.d/slow && ln -s ../init.d/slow /tmp/kept/etc/rc.d/S94slow
tar -czf /lab/node/flash/sysupgrade.tgz -C /tmp/kept etc && touch /lab/node/flash/slow
"""


def _accepts_logins(node: VirtualNode) -> bool:
    """Whether its first boot has come that far. While the old processes end, it is off."""
    try:
        return node.exec("[ -e /sysupgrade.tgz ] && pidof dropbear").exit_status == 0
    except LabError:
        return False


def test_a_change_waits_until_the_first_boot_has_ended_and_survives_the_next_one(rig: Rig) -> None:
    old, new = rig.flip()
    node = rig.fleet.node("n001")
    node.exec(KEPT).check("keep the configuration over a flash")
    slow = rig.fleet.directory / "nodes" / "n001" / "flash" / "slow"
    node.power_cut(back=False)
    rig.fleet.request("power_on", node="n001")
    until(lambda: _accepts_logins(node), "logins in the first boot")
    said = []
    with rig.start("provision", new, "--yes") as process:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            if "waiting until its first boot has ended" in line:
                assert "n001: apply\n" not in said
                assert rig.state_of("n001", old, new) == "old"
                slow.unlink()
        assert process.stderr is not None
        stderr = process.stderr.read()
    assert process.returncode == 0, "".join(said) + stderr
    assert not slow.exists(), "".join(said)
    node.power_cut()
    assert rig.state_of("n001", old, new) == "new"
    node.exec("rm -f /etc/init.d/slow /etc/rc.d/S94slow; sync")
