"""The one way a value gets into a template: `{{ value | uci }}`. An expression without it is an error.

Jinja2 itself is told to accept nothing but the filter's own results in UCI templates (`require_quoted`), so a template
cannot forget to quote.
"""

from __future__ import annotations

from ipaddress import IPv4Address, IPv4Interface

from jinja2 import Undefined

from meshctl import uci
from meshctl.model import Secret


class Quoted(str):
    """Text that the filter has made."""

    __slots__ = ()


class UnquotedValue(ValueError):
    """An expression in a UCI template that does not end in `| uci`."""


def quoted(value: object) -> Quoted:
    """`value` as one UCI argument in quotes: text, numbers, addresses, booleans as 1 and 0, secrets revealed.

    Raises ValueError for empty text, which UCI reads as no option at all, and for a NUL; TypeError for anything else.
    """
    match value:
        case Undefined():
            # raises jinja2's own error, which names what is missing
            return Quoted(str(value))
        case bool():
            return Quoted(uci.quote("1" if value else "0"))
        case Secret():
            return Quoted(uci.quote(_not_empty(value.reveal())))
        case str():
            return Quoted(uci.quote(_not_empty(value)))
        case int() | float() | IPv4Address() | IPv4Interface():
            return Quoted(uci.quote(str(value)))
        case _:
            raise TypeError(f"expected text, a number, an address or a boolean, found {type(value).__name__}")


def _not_empty(value: str) -> str:
    if not value:
        raise ValueError("expected a value, found empty text, which UCI reads as no option at all")
    return value


def require_quoted(value: object) -> str:
    """What jinja2 calls on every expression of a UCI template. Raises UnquotedValue."""
    if isinstance(value, Quoted):
        return value
    if isinstance(value, Undefined):
        return str(value)
    raise UnquotedValue(f"expected every expression to end in `| uci`, found a plain {type(value).__name__}")


def revealed(value: object) -> str:
    """The filter `reveal`, for files that are not UCI: a secret's text. Raises TypeError for anything else."""
    if not isinstance(value, Secret):
        raise TypeError(f"expected a secret, found {type(value).__name__}")
    return value.reveal()
