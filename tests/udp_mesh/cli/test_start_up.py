"""Commands that only talk to the daemon start without the transport: scripts call them often, on slow computers."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.start_up import imported_modules, packages


@pytest.mark.parametrize(
    "words", [["--help"], ["--version"], ["status"], ["pub", "t", "x"], ["echo", "t"], ["run", "--help"]], ids=" ".join
)
def test_a_command_imports_only_stdlib_and_no_transport_modules(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UDP_MESH_SOCKET", str(tmp_path / "no daemon"))
    imported = imported_modules("udp_mesh.cli.main", words, tmp_path)
    assert packages(imported) == {"udp_mesh"}
    transport = ("udp_mesh.core", "udp_mesh.crypto", "udp_mesh.links", "udp_mesh.wire", "udp_mesh.daemon.")
    assert {name for name in imported if name.startswith(transport)} == {"udp_mesh.daemon.interface"}
    assert not imported & {"asyncio", "importlib.metadata", "logging", "ssl"}
