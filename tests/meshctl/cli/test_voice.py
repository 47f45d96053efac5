"""The spoken advice, with Debian's espeak-ng on ALSA's own devices."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.cli.voice import Voice
from meshctl.errors import InputError
from tests.meshctl.cli.speech_program import use_sound_card

PLAYS = "type null"
MISSING = "type hw card 31"


def test_a_phrase_is_spoken_on_a_sound_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_sound_card(tmp_path / "alsa.conf", PLAYS, monkeypatch)
    voice = Voice()
    assert not voice.is_speaking
    voice.say("drop now")
    voice.wait()
    assert not voice.is_speaking
    assert voice.problem == ""


def test_nothing_that_can_be_heard_is_a_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_sound_card(tmp_path / "alsa.conf", MISSING, monkeypatch)
    voice = Voice()
    voice.say("drop now")
    voice.wait()
    assert voice.problem.startswith("no sound: espeak-ng: error: ")
    # A card that is plugged in later is used.
    use_sound_card(tmp_path / "alsa.conf", PLAYS, monkeypatch)
    voice.say("drop now")
    voice.wait()
    assert voice.problem == ""


def test_a_voice_that_is_killed_or_removed_is_a_problem_and_no_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_sound_card(tmp_path / "alsa.conf", PLAYS, monkeypatch)
    voice = Voice()
    programs = tmp_path / "programs"
    programs.mkdir()
    killed = programs / "espeak-ng"
    killed.write_text("#!/bin/sh\nkill -KILL $$\n")
    killed.chmod(0o755)
    monkeypatch.setenv("PATH", str(programs), prepend=":")
    voice.say("turn back")
    voice.wait()
    assert voice.problem == "no sound: espeak-ng was ended by signal 9"
    killed.unlink()
    monkeypatch.setenv("PATH", str(programs))
    voice.say("turn back")
    assert voice.problem == "no sound: espeak-ng: No such file or directory"


def test_a_missing_program_is_named_with_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="espeak-ng is not installed"):
        Voice()
