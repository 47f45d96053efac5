"""Quote template values: every expression in a UCI template must be `{{ value | uci }}`.

Jinja2 is configured to accept only the filter's results in UCI templates (`require_quoted`), so a missing filter is an
error.
"""

from __future__ import annotations

from ipaddress import IPv4Address, IPv4Interface, IPv6Address, IPv6Interface, IPv6Network

from jinja2 import Undefined

from meshctl import uci
from meshctl.model import Secret


class Quoted(str):
    """The result of the `uci` filter."""

    __slots__ = ()


class UnquotedValue(ValueError):
    """An expression in a UCI template that does not end in `| uci`."""


def quoted(value: object) -> Quoted:
    """`value` as one quoted UCI argument: text, numbers, addresses, booleans as 1 and 0, secrets in plain text.

    Raises ValueError for empty text, which UCI treats as a missing option, and for NUL; TypeError for other types.
    """
    match value:
        case Undefined():
            # raises jinja2's own error with the missing name
            return Quoted(str(value))
        case bool():
            return Quoted(uci.quote("1" if value else "0"))
        case Secret():
            return Quoted(uci.quote(_not_empty(value.reveal())))
        case str():
            return Quoted(uci.quote(_not_empty(value)))
        case int() | float() | IPv4Address() | IPv4Interface() | IPv6Address() | IPv6Interface() | IPv6Network():
            return Quoted(uci.quote(str(value)))
        case _:
            raise TypeError(f"expected text, a number, an address or a boolean, found {type(value).__name__}")


def _not_empty(value: str) -> str:
    if not value:
        raise ValueError("expected a value, found empty text, which UCI treats as a missing option")
    return value


def require_quoted(value: object) -> str:
    """Jinja2's `finalize` hook for expressions of UCI templates. Raises UnquotedValue."""
    if isinstance(value, Quoted):
        return value
    if isinstance(value, Undefined):
        return str(value)
    raise UnquotedValue(f"expected every expression to end in `| uci`, found a plain {type(value).__name__}")


def revealed(value: object) -> str:
    """The filter `reveal`, for files that are not UCI: a secret in plain text. Raises TypeError for other types."""
    if not isinstance(value, Secret):
        raise TypeError(f"expected a secret, found {type(value).__name__}")
    return value.reveal()
