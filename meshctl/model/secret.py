"""Secrets: references from the inventory, and values that are never printed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

MASK = "********"


class SecretKind(Enum):
    """The location of a secret: an environment variable, a file outside the repository, an age-encrypted file."""

    ENV = "env"
    FILE = "file"
    AGE = "age"


@dataclass(frozen=True, slots=True)
class SecretRef:
    """`{env: NAME}`, `{file: PATH, key: NAME}` or `{age: PATH, key: NAME, identity: PATH}`.

    `where` is the variable's name or the path (as written, relative to the file that names it; `base` is that
    file's directory); `key` picks one entry of a YAML mapping, empty for the whole file.
    """

    kind: SecretKind
    where: str
    key: str = ""
    identity: str = ""
    base: str = ""

    def __str__(self) -> str:
        return f"{self.kind.value}:{self.where}" + (f"#{self.key}" if self.key else "")


class Secret:
    """A secret value; its text forms are masked, only `reveal()` returns it."""

    __slots__ = ("_value",)

    def __init__(self, value: str) -> None:
        self._value = value

    def reveal(self) -> str:
        """The value; call it only to write it to a node or to a file that the user requested."""
        return self._value

    def __repr__(self) -> str:
        return f"Secret({MASK})"

    def __str__(self) -> str:
        return MASK

    def __format__(self, spec: str) -> str:
        return format(MASK, spec)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Secret) and other._value == self._value

    def __hash__(self) -> int:
        return hash(("Secret", self._value))

    def __reduce__(self) -> str:
        raise TypeError("secrets must not be serialized")
