"""Values of arguments: text -> number, or an error that argparse prints."""

from __future__ import annotations

import argparse
from math import isfinite

from udp_mesh.daemon.interface import MAX_PING_S

MAX_COUNT = 1_000_000_000


def positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a positive number, found {text!r}")
    return value


def ping_s(text: str) -> float:
    value = positive(text)
    if value > MAX_PING_S:
        raise argparse.ArgumentTypeError(f"expected at most {MAX_PING_S:g} seconds, found {text!r}")
    return value


def coordinate(text: str) -> float:
    """Meters, in either direction."""
    try:
        value = float(text)
    except ValueError:
        value = float("inf")
    if not isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a number of meters, such as 12.5, found {text!r}")
    return value


def count(text: str) -> int:
    """A number of repetitions."""
    if not (text.isascii() and text.isdecimal()) or not 1 <= int(text) <= MAX_COUNT:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, found {text!r}")
    return int(text)
