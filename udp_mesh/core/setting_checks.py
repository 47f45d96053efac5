"""Checks of settings that a program passes: dataclasses do not check types, and text is also a sequence."""

from collections.abc import Sequence
from enum import Enum

from udp_mesh.wire.limits import MAX_TYPE_BYTES


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
    """Raises TypeError unless the value is of this type; `bool` is no `int`."""
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise TypeError(f"{what}: expected {_named(kind)}, found {_found(value)}")


def check_items(values: Sequence[object], kind: type, what: str) -> None:
    """Raises TypeError unless the values are a sequence of this type. Text, a sequence of letters, is none."""
    if isinstance(values, str | bytes) or not isinstance(values, Sequence):
        raise TypeError(f"{what}: expected a tuple of {kind.__name__}, found {_found(values)}")
    for value in values:
        check_type(value, kind, what)


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
