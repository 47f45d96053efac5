"""Checks of settings that a program passes: dataclasses do not check types, and text is also a sequence."""

import dataclasses
from collections.abc import Iterator, Sequence
from enum import Enum
from functools import cache
from numbers import Integral, Real
from types import UnionType
from typing import TYPE_CHECKING, Any, Literal, Union, cast, get_args, get_origin

from udp_mesh.wire.limits import MAX_TYPE_BYTES

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_NUMBERS: dict[type, type] = {int: Integral, float: Real}


def is_name(name: str, limit_bytes: int) -> bool:
    """Whether the wire format accepts this as the name of a node or a topic."""
    # Surrogates are not printable, so a printable string can be encoded.
    return name.isprintable() and not any(map(str.isspace, name)) and 1 <= len(name.encode()) <= limit_bytes


def is_type_name(name: str) -> bool:
    """Whether the wire format accepts this as the name of a topic's type, which may be empty."""
    return name.isprintable() and len(name.encode()) <= MAX_TYPE_BYTES


def check_name(name: str, what: str, limit_bytes: int) -> None:
    """Raises ValueError unless `is_name` holds, and TypeError if the name is not text."""
    check_type(name, str, what)
    if not 0 < len(name.encode(errors="surrogatepass")) <= limit_bytes:
        raise ValueError(f"{what} {name!r}: expected 1 to {limit_bytes} bytes")
    if not is_name(name, limit_bytes):
        raise ValueError(f"{what} {name!r}: expected no white space and no control characters")


def check_type(value: object, kind: type, what: str) -> None:
    """Raises TypeError unless the value is of this type; `bool` is no number, and NumPy's numbers are some."""
    if not isinstance(value, _NUMBERS.get(kind, kind)) or (kind in _NUMBERS and isinstance(value, bool)):
        raise TypeError(f"{what}: expected {_named(kind)}, found {_found(value)}")


def check_items(values: Sequence[object], kind: type, what: str) -> None:
    """Raises TypeError unless the values are a sequence of this type. Text, a sequence of letters, is none."""
    if isinstance(values, str | bytes) or not isinstance(values, Sequence):
        raise TypeError(f"{what}: expected a tuple of {kind.__name__}, found {_found(values)}")
    for value in values:
        check_type(value, kind, what)


def check_fields(settings: "DataclassInstance", what: str = "") -> None:
    """Raises TypeError if a field of the dataclass does not have the type that it declares; `what` is put before its
    name. A whole number is accepted for a float, and a list for a tuple."""
    for name, declared, usual, may_be_empty in _fields(type(settings)):
        value = getattr(settings, name)
        # a topic is made for each message on one that is not declared
        if type(value) not in usual and not (may_be_empty and value == ()):
            _check(value, declared, f"{what}{name}")


@cache
def _fields(settings: "type[DataclassInstance]") -> tuple[tuple[str, Any, frozenset[type], bool], ...]:
    """The name and the declared type of each field, the types of values that need no further check, and whether it is a
    tuple of any length."""
    return tuple(
        (field.name, field.type, frozenset(_usual(field.type)), Ellipsis in get_args(field.type))
        for field in dataclasses.fields(settings)
    )


def _usual(declared: Any) -> Iterator[type]:
    if get_origin(declared) in (Union, UnionType):
        for kind in get_args(declared):
            yield from _usual(kind)
    elif declared is float:
        yield from (int, float)
    elif isinstance(declared, type) and get_origin(declared) is None:
        yield declared


def _check(value: object, declared: Any, what: str) -> None:
    origin, inner = get_origin(declared), get_args(declared)
    if origin is Literal:
        if value not in inner:
            raise TypeError(f"{what}: expected {inner[0]!r}, found {_found(value)}")
    elif origin in (Union, UnionType):
        kinds = [kind for kind in inner if kind is not type(None)]
        if value is None and len(kinds) < len(inner):
            return
        if get_origin(kinds[0]) is not Literal or value not in get_args(kinds[0]):
            _check(value, kinds[-1], what)
    elif origin is tuple and inner[1:] == (Ellipsis,):
        check_items(cast(Any, value), inner[0], what)
    elif origin is tuple:
        if not isinstance(value, tuple | list) or len(value) != len(inner):
            names = ", ".join(kind.__name__ for kind in inner)
            raise TypeError(f"{what}: expected ({names}), found {_found(value)}")
        for one, kind in zip(value, inner, strict=True):
            check_type(one, kind, what)
    else:
        check_type(value, declared, what)


def written(value: object) -> object:
    """A value as it is written in a configuration."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return value.value if isinstance(value, Enum) else value


def _named(kind: type) -> str:
    if issubclass(kind, Enum):
        return "one of " + ", ".join(str(member) for member in kind)
    return kind.__name__


def _found(value: object) -> str:
    # never the value of a key, which may be passed as text or bytes
    if isinstance(value, int | float) or (isinstance(value, str) and len(value) < 16):
        return f"{value!r} ({type(value).__name__})"
    return type(value).__name__
