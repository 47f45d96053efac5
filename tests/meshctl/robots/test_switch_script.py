"""What the script that switches releases takes from the daemon's answers."""

from pathlib import Path

from meshctl import robots
from udp_mesh.daemon.service import AFTER_RESTART


def test_the_switch_looks_for_the_daemons_own_words_for_a_restart() -> None:
    """They once differed: a changed port was deployed, and the daemon kept the old one."""
    script = Path(robots.__file__).with_name("scripts") / "switch.sh"
    assert f'*"{AFTER_RESTART}"*) return 1' in script.read_text(encoding="utf-8")
