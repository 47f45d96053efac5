"""From root to an ordinary user: irrevocably, with the directories it owns; without root it is an error."""

import os
import pwd
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from udp_mesh.daemon.privileges import drop_privileges

SCRIPT = """
import os, sys
from pathlib import Path
from udp_mesh.daemon.privileges import drop_privileges
drop_privileges("nobody", (Path(sys.argv[1]),))
(Path(sys.argv[1]) / "file").write_text("mine")
try:
    os.setuid(0)
except PermissionError:
    print("nobody" if os.getuid() == os.geteuid() != 0 else "root")
"""


def test_an_unknown_user_is_an_error_that_names_the_key() -> None:
    with pytest.raises(OSError, match=r"daemon\.user: no such user: 'no-such-user'"):
        drop_privileges("no-such-user", ())


def test_dropping_privileges_to_the_current_user_does_nothing(tmp_path: Path) -> None:
    drop_privileges(pwd.getpwuid(os.geteuid()).pw_name, (tmp_path / "state",))
    assert not (tmp_path / "state").exists()


def test_root_drops_privileges_permanently_and_other_users_are_refused() -> None:
    """Both cases: as root the process ends as nobody; as anyone else it is refused."""
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        folder.chmod(0o755)
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, str(folder / "state")], check=False, capture_output=True, text=True
        )
        if os.geteuid() == 0:
            assert (done.stdout, done.returncode) == ("nobody\n", 0), done.stderr
            assert (folder / "state" / "file").stat().st_uid == pwd.getpwnam("nobody").pw_uid
        else:
            assert "Operation not permitted" in done.stderr
