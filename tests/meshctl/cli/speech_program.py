"""Debian's espeak-ng, and sound cards for it: one that plays, and one that is missing."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

NEEDS_SPEECH = "MESHCTL_TESTS_NEED_SPEECH"


def expects_speech() -> bool:
    """Whether its tests are collected: where it is installed, and where it must be."""
    return bool(os.environ.get(NEEDS_SPEECH)) or shutil.which("espeak-ng") is not None


def use_sound_card(path: Path, definition: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give programs this ALSA device as the only way to make sound."""
    path.write_text(f"pcm.!default {{ {definition} }}\n")
    monkeypatch.setenv("ALSA_CONFIG_PATH", str(path))
    monkeypatch.setenv("PULSE_SERVER", f"unix:{path}.pulse")
    monkeypatch.setenv("PULSE_CLIENTCONFIG", str(path) + ".none")
