"""A new fleet key without an interruption: the inventory's keys -> the stages still to come.

Pure. A daemon opens with every live key and seals with the first: so the new key is first accepted everywhere, then
used everywhere, and only then is the old one dropped. Each stage must have reached every robot before the next begins;
the inventory itself says how far a rotation has come, so one that was interrupted is taken up by the same command.
"""

from __future__ import annotations

from dataclasses import dataclass

from meshctl.errors import InputError
from meshctl.inventory.yaml_text import Value
from meshctl.model import SecretKind, SecretRef


@dataclass(frozen=True, slots=True)
class RotationStage:
    """`keys` are the live keys of this stage, the sealing one first."""

    title: str
    keys: tuple[SecretRef, ...]


def rotation_stages(keys: tuple[SecretRef, ...], new: SecretRef) -> tuple[RotationStage, ...]:
    """The stages from what the inventory has to `new` alone; the first is the one that may be half done.

    Raises InputError for an unkeyed fleet and for one in the middle of another rotation.
    """
    if not keys:
        raise InputError("the fleet has no key yet", hint="write udp_mesh.keys and deploy; all robots at once")
    others = tuple(key for key in keys if _same(key) != _same(new))
    if len(others) > 1:
        names = ", ".join(map(str, others))
        raise InputError(f"two other keys are live: {names}", hint="finish that rotation first, with the second as new")
    done = RotationStage("the old key is dropped", (new,))
    if not others:
        return (done,)
    (old,) = others
    sealing = RotationStage("the new key seals", (new, old))
    if _same(keys[0]) == _same(new):
        return sealing, done
    return RotationStage("the new key is accepted", (old, new)), sealing, done


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
    """The reference as an inventory writes it."""
    value: dict[str, Value] = {ref.kind.value: ref.where}
    if ref.key:
        value["key"] = ref.key
    if ref.identity:
        value["identity"] = ref.identity
    return value
