"""Which tests of commands are collected here."""

from __future__ import annotations

from tests.meshctl.cli.speech_program import expects_speech

collect_ignore = [] if expects_speech() else ["test_voice.py"]
