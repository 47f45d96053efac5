"""Files that a command writes onto a full disk: a limit on files' sizes fails the write, as that does."""

import resource
from pathlib import Path

import pytest

from udp_mesh.cli.main import main
from udp_mesh.cli.output import Exit


def test_keygen_on_a_full_disk_leaves_no_file_without_a_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "fleet.key"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        code = main(["keygen", str(path)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == Exit.FAILED
    assert capsys.readouterr().err == f"udp-mesh: {path}: File too large\n"
    assert not path.exists()
    assert main(["keygen", str(path)]) == Exit.OK
