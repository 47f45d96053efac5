"""Pinning a host key: what the operator sees and answers decides, for a new key and for a changed one."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest
import typer

from meshctl.cli.key_pinning import pin_host_key
from meshctl.device.trust import HostKey, TrustStore


def key(seed: int) -> HostKey:
    kind = b"ssh-ed25519"
    return HostKey(kind.decode(), len(kind).to_bytes(4, "big") + kind + b"\0\0\0\x20" + bytes([seed]) * 32)


OLD, NEW = key(1), key(2)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Operator:
    """Answers the question, and keeps what was on the screen when it came."""

    def __init__(self, answer: bool | None, screen: pytest.CaptureFixture[str]) -> None:
        self.screens: list[str] = []
        self._answer = bool(answer)
        self._screen = screen

    def __call__(self, _question: str) -> bool:
        self.screens.append(self._screen.readouterr().out)
        return self._answer


@pytest.fixture
def trust(tmp_path: Path) -> TrustStore:
    store = TrustStore(tmp_path / "known_hosts")
    store.replace("site.north", OLD)
    return store


def pin(trust: TrustStore, name: str, shown: HostKey, **choices: bool) -> bool:
    given = {"may_replace": False, "yes": False, **choices}
    return pin_host_key(trust, name, shown, label="north", device="gateway", **given)


@pytest.mark.parametrize(
    ("name", "choices", "answer", "expected"),
    [
        ("site.south", {}, True, NEW),
        ("site.south", {}, False, None),
        ("site.south", {"yes": True}, None, NEW),
        ("site.south", {"yes": True, "dry_run": True}, None, None),
        ("site.south", {"quiet": True}, None, None),
        ("site.south", {"quiet": True, "yes": True}, None, NEW),
        ("site.north", {"yes": True}, None, OLD),
        ("site.north", {"may_replace": True}, True, NEW),
        ("site.north", {"may_replace": True}, False, OLD),
        ("site.north", {"may_replace": True, "dry_run": True}, None, OLD),
    ],
)
def test_a_key_is_pinned_only_as_the_operator_chose(
    trust: TrustStore,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
    choices: dict[str, bool],
    answer: bool | None,
    expected: HostKey | None,
) -> None:
    operator = Operator(answer, capsys)
    monkeypatch.setattr(sys, "stdin", Terminal())
    monkeypatch.setattr(typer, "confirm", operator)
    is_trusted = pin(trust, name, NEW, **choices)
    assert tuple(trust.pinned(name)) == (() if expected is None else (expected,))
    assert is_trusted is (expected == NEW or "dry_run" in choices)
    assert bool(operator.screens) is (answer is not None)


def test_a_changed_key_is_shown_with_the_pinned_one_before_the_question(
    trust: TrustStore, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal())
    operator = Operator(False, capsys)
    monkeypatch.setattr(typer, "confirm", operator)
    assert not pin(trust, "site.north", NEW, may_replace=True)
    assert f"{NEW.fingerprint} (ssh-ed25519): DIFFERS from the pinned {OLD.fingerprint}" in operator.screens[0]


def test_without_a_terminal_the_hint_says_how_to_confirm(
    trust: TrustStore, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert not pin(trust, "site.south", NEW)
    assert "compare the fingerprint with that of the gateway, then pass --yes" in capsys.readouterr().out
