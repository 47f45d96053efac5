"""`meshctl sites` with names and settings that do not fit: the message says what the inventory has."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.cli.main import main
from tests.meshctl.inventory.inventories import HEAD

_SITES = "sites: {north: {ssh: {host: 192.0.2.1}}, label-only: {}}\n"


@pytest.mark.parametrize(
    ("words", "error", "hint"),
    [
        (["status", "nort"], "no site of trial is named 'nort'", "did you mean 'north'?"),
        (["trust", "xyz"], "no site of trial is named 'xyz'", "its sites are north, label-only"),
        (["status", "label-only"], "site label-only has no gateway", "set sites.label-only.ssh.host or"),
        # it said that the site has `nats`
        (["cancel", "north", "3"], "site north has no `nats`, so no order waits for it", "orders for north are sent"),
    ],
)
def test_a_site_that_does_not_fit_is_explained(
    words: list[str],
    error: str,
    hint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("MESHCTL_LAB", raising=False)
    inventory = tmp_path / "fleet.yaml"
    inventory.write_text(HEAD + _SITES, encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        main(["sites", *words, "-i", str(inventory)])
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert f"error: {error}" in said
    assert f"hint: {hint}" in said
