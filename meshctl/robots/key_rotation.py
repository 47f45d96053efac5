"""Rotate the fleet key without an interruption: the inventory's keys -> the remaining stages. Pure.

A daemon decrypts with every live key and encrypts with the first: the new key is accepted everywhere, then used
everywhere, then the old one is dropped. Each stage must reach every robot before the next starts. The inventory records
the progress, so the same command resumes an interrupted rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

from meshctl.errors import InputError
from meshctl.inventory.yaml_text import Value
from meshctl.model import SecretKind, SecretRef


@dataclass(frozen=True, slots=True)
class RotationStage:
    """`keys` are the live keys of this stage, the encrypting one first."""

    title: str
    keys: tuple[SecretRef, ...]


def rotation_stages(keys: tuple[SecretRef, ...], new: SecretRef) -> tuple[RotationStage, ...]:
    """The stages from the inventory's keys to `new` alone; the first one may be partly done.

    Raises InputError for a fleet without a key, or during another rotation.
    """
    if not keys:
        raise InputError("the fleet has no key", hint="set udp_mesh.keys, then deploy all robots")
    others = tuple(key for key in keys if _same(key) != _same(new))
    if len(others) > 1:
        names = ", ".join(map(str, others))
        raise InputError(f"two other keys are live: {names}", hint="first finish that rotation, to the second one")
    done = RotationStage("drop the old key", (new,))
    if not others:
        return (done,)
    (old,) = others
    sealing = RotationStage("use the new key", (new, old))
    if _same(keys[0]) == _same(new):
        return sealing, done
    return RotationStage("accept the new key", (old, new)), sealing, done


def _same(ref: SecretRef) -> tuple[SecretKind, str, str]:
    return ref.kind, ref.where, ref.key


def parse_ref(text: str) -> SecretRef:
    """`env:NAME`, `file:PATH`, `file:PATH#KEY` or `age:PATH#KEY`, as `SecretRef` prints itself. Raises InputError."""
    kind, colon, rest = text.partition(":")
    where, _, key = rest.partition("#")
    try:
        if not colon or not where:
            raise ValueError(text)
        return SecretRef(SecretKind(kind), where, key)
    except ValueError:
        raise InputError(f"expected env:NAME, file:PATH, file:PATH#KEY or age:PATH#KEY, found {text!r}") from None


def inventory_value(ref: SecretRef) -> Value:
    """The reference as an inventory value."""
    value: dict[str, Value] = {ref.kind.value: ref.where}
    if ref.key:
        value["key"] = ref.key
    if ref.identity:
        value["identity"] = ref.identity
    return value
