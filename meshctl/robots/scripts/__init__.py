"""The shell scripts meshctl runs on a robot's computer, as they are in this directory (docs/robots.md)."""

from __future__ import annotations

from pathlib import Path

_DIRECTORY = Path(__file__).resolve().parent


def script(name: str) -> str:
    """The text of one verb (`probe`, `install`, `switch`, ...), with the part that all of them share before it."""
    return shipped("common.sh") + shipped(f"{name}.sh")


def shipped(name: str) -> str:
    """The text of one file here."""
    return (_DIRECTORY / name).read_text(encoding="utf-8")
