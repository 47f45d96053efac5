"""Tree -> document, or a diagnostic with its position for each violation of the format."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from meshctl.diagnostics import Diagnostic, Position
from meshctl.inventory import codes
from meshctl.inventory.compose import printable
from meshctl.inventory.documents import InventoryDocument, SecretDocument
from meshctl.inventory.tree import MappingNode, Scalar, Tree, child, describe, key_position, plain_data, position
from meshctl.suggest import did_you_mean, nearest, suggestion

_REFERENCE = "a reference: {env: NAME}, {file: PATH, key: NAME} or {age: PATH, key: NAME}"
# Values of these keys may be secrets in place of references; messages never repeat them.
_SECRET_KEYS = frozenset({"key", "keys", "env", "password", "passphrase", "psk"})
_KINDS = {
    "model_type": "a mapping",
    "dict_type": "a mapping",
    "list_type": "a list",
    "tuple_type": "a list",
    "string_type": "text",
    "string_too_short": "text that is not empty",
}
_CONTAINERS = frozenset({"model_type", "dict_type", "list_type", "tuple_type"})
_BOUNDS = {
    "greater_than_equal": ("at least", "ge"),
    "greater_than": ("more than", "gt"),
    "less_than_equal": ("at most", "le"),
    "less_than": ("less than", "lt"),
}
_PATTERNS = {
    "^([a-z0-9]+(-[a-z0-9]+)*)?$": "a driver's name such as ath10k-ct",
    "^([0-9a-fA-F]{64})?$": "64 hexadecimal digits",
    "^(BATMAN_IV|BATMAN_V)$": "one of 'BATMAN_IV', 'BATMAN_V'",
    "^(off|client|server)$": "one of 'off', 'client', 'server'",
    "^([A-Za-z_][A-Za-z0-9_]*)?$": "the name of an environment variable such as MESH_KEY",
}
# The end of a key's name, and the unit of its value.
_UNITS = {
    "_bytes_per_s": "bytes per second",
    "bits_per_s": "bits per second",
    "_bytes": "bytes",
    "_db": "dB",
    "_dbi": "dBi",
    "_dbm": "dBm",
    "_deg": "degrees",
    "_hz": "Hz",
    "_kbps": "kbit/s",
    "_kib": "KiB",
    "_m": "meters",
    "_mib": "MiB",
    "_ms": "milliseconds",
    "_s": "seconds",
    "_tu": "time units of 1.024 ms",
}
# Names of keys in UCI, of other tools and of the field, and the keys that they mean where a mapping has them.
_OTHER_NAMES: Mapping[str, tuple[str, ...]] = {
    "authorized_keys": ("ssh_keys",),
    "antenna_gain": ("antenna_gain_dbi",),
    "bandwidth": ("htmode",),
    "cell_id": ("bssid",),
    "channel_width": ("htmode",),
    "distance": ("distance_m",),
    "essid": ("ssid",),
    "gain": ("antenna_gain_dbi",),
    "hop_limit": ("relay_hops",),
    "ifname": ("lan_ports",),
    "ip": ("address",),
    "ipaddr": ("address",),
    "ip_address": ("address",),
    "mesh_id": ("ssid",),
    "model": ("board",),
    "name": ("hostname", "ssid"),
    "ntp": ("ntp_servers",),
    "ntp_server": ("ntp_servers",),
    "passphrase": ("key",),
    "password": ("key",),
    "ports": ("lan_ports",),
    "power": ("tx_power_dbm",),
    "protocol": ("backend",),
    "psk": ("key",),
    "public_keys": ("ssh_keys",),
    "regdomain": ("country",),
    "routing": ("backend",),
    "subnet": ("network",),
    "syslog": ("log_host",),
    "tags": ("groups",),
    "tx_power": ("tx_power_dbm",),
    "txpower": ("tx_power_dbm",),
    "width": ("htmode",),
}
# Values in UCI's and the field's words, by key, and the values that they mean.
_OTHER_VALUES: Mapping[str, Mapping[str, str]] = {
    "mode": {"11s": "mesh", "802.11s": "mesh", "mesh point": "mesh", "meshpoint": "mesh", "ibss": "adhoc"},
    "band": {"2.4": "2g", "2.4ghz": "2g", "5": "5g", "5ghz": "5g"},
    "encryption": {
        "open": "none",
        "psk2": "psk2+ccmp",
        "psk2+aes": "psk2+ccmp",
        "wpa2": "psk2+ccmp",
        "wpa2-psk": "psk2+ccmp",
        "wpa3": "sae",
    },
    "backend": {"batman": "batman-adv", "batadv": "batman-adv", "bat0": "batman-adv"},
    "role": {
        "ap": "beacon",
        "client": "beacon",
        "gateway": "base",
        "node": "beacon",
        "relay": "beacon",
        "repeater": "beacon",
        "router": "beacon",
        "station": "base",
    },
    "state": {"active": "deployed", "offline": "spare", "online": "deployed", "stored": "spare"},
}
# Keys whose values are shares of a whole.
_SHARES = frozenset({"quorum", "duty_cycle", "scale"})
_PERCENT = re.compile(r"([0-9]{1,3}(?:\.[0-9]{1,6})?) ?%?")
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]{1,9},[0-9]{1,9}")
_WITH_UNIT = re.compile(r"[-+]?[0-9.,]+ ?[A-Za-z]{1,8}(/s)?")


@dataclass(frozen=True, slots=True)
class Validated:
    """`document` is None if there is any diagnostic."""

    document: InventoryDocument | None
    diagnostics: tuple[Diagnostic, ...]


def validate(root: MappingNode) -> Validated:
    """Validate the whole tree."""
    try:
        return Validated(InventoryDocument.model_validate(plain_data(root)), ())
    except ValidationError as reason:
        errors = reason.errors(include_url=False, include_input=False)
        problems = [_diagnostic(root, error) for error in _without_misspelled(root, errors[: codes.MAX_DIAGNOSTICS])]
        if len(errors) > codes.MAX_DIAGNOSTICS:
            problems.append(codes.too_many(problems[-1].position))
        return Validated(None, tuple(problems))


def _without_misspelled(root: MappingNode, errors: list[ErrorDetails]) -> list[ErrorDetails]:
    """Without keys that are missing because they are misspelled, or come with a merge key: that is the mistake."""
    meant = {
        (*parent, near)
        for *parent, wrong in (error["loc"] for error in errors if error["type"] == "extra_forbidden")
        for near in _meant(str(wrong), _known_keys(parent))
    }
    return [
        error
        for error in errors
        if error["type"] != "missing" or not (error["loc"] in meant or _is_partial(root, error["loc"][:-1]))
    ]


def _is_partial(root: MappingNode, path: tuple[int | str, ...]) -> bool:
    tree: Tree | None = root
    for part in path:
        if tree is None:
            return False
        tree = child(tree, part)
    return isinstance(tree, MappingNode) and tree.is_partial


def _meant(wrong: str, known: Sequence[str]) -> tuple[str, ...]:
    """The keys that an unknown one probably is: the same with its unit (`x` for `x_m`), one with another name, else
    the most similar ones."""
    with_unit = tuple(f"{wrong}{unit}" for unit in _UNITS if f"{wrong}{unit}" in known)
    renamed = tuple(key for key in _OTHER_NAMES.get(wrong.lower(), ()) if key in known)
    return with_unit or renamed[:1] or nearest(wrong, known)


def _diagnostic(root: MappingNode, error: ErrorDetails) -> Diagnostic:
    """Translate one of pydantic's errors; its location is a path into the tree."""
    location = error["loc"]
    is_key = bool(location) and location[-1] == "[key]"
    path = location[:-1] if is_key else location
    kind = error["type"]
    place = _place(root, path, is_key=is_key or kind == "extra_forbidden")
    dotted = ".".join(printable(str(part)) for part in path)
    if kind == "missing":
        dotted = ".".join(printable(str(part)) for part in path[:-1])
        return codes.error(codes.MISSING_KEY, place, f"missing key '{path[-1]}'", path=dotted)
    if kind == "extra_forbidden":
        known = _known_keys(path[:-1])
        wrong = str(path[-1])
        hint = suggestion(_meant(wrong, known)) or f"known keys: {', '.join(known)}"
        if wrong.startswith(("x-", ".")):
            hint = "no key holds values for anchors alone: set the anchor (`&`) where its value is first used"
        if _is_rest_of_a_text(root, path):
            hint = "a comma ends a text within {}: if this belongs to the text before it, quote the whole text"
        return codes.error(codes.UNKNOWN_KEY, place, f"unknown key '{printable(wrong)}'", path=dotted, hint=hint)
    expected = expected_value(error)
    found = f"'{printable(str(path[-1]))}'" if is_key else _found(root, path, kind)
    hint = _enum_hint(root, path, error) if kind == "enum" else _unit_hint(root, path)
    if kind in ("list_type", "tuple_type") and found not in ("", "nothing"):
        hint = f"put it in brackets: `{path[-1]}: [...]`"
    return codes.error(codes.WRONG_VALUE, place, "", path=dotted, expected=expected, found=found, hint=hint)


def _is_rest_of_a_text(root: MappingNode, path: tuple[int | str, ...]) -> bool:
    """Whether a key without a value follows a plain text in flow style: `{timezone: MST7MDT,M3.2.0,M11.1.0}`."""
    tree: Tree | None = root
    for part in path[:-1]:
        tree = None if tree is None else child(tree, part)
    if not isinstance(tree, MappingNode) or not tree.is_flow or str(path[-1]) not in tree.keys:
        return False
    entries = list(tree.values.items())
    number = next(number for number, (key, _) in enumerate(entries) if key == str(path[-1]))
    value, before = entries[number][1], entries[number - 1][1]
    is_bare = isinstance(value, Scalar) and value.is_null and not value.text
    return number > 0 and is_bare and isinstance(before, Scalar) and before.is_plain


def _place(root: MappingNode, path: tuple[int | str, ...], *, is_key: bool) -> Position:
    """The position of the value at `path`; of its container's key if there is none."""
    tree: Tree = root
    place = position(root)
    for number, part in enumerate(path):
        if isinstance(tree, MappingNode) and str(part) in tree.keys:
            place = key_position(tree, str(part))
        below = child(tree, part)
        if below is None:
            return place
        tree = below
        is_last = number == len(path) - 1
        written_here = isinstance(tree, Scalar) and not tree.is_null
        if (is_last and not is_key and written_here) or isinstance(part, int):
            place = position(tree)
    return place


def expected_value(error: ErrorDetails) -> str:
    """The expected value of a pydantic error, for `expected ...` in a message."""
    kind = error["type"]
    context: Mapping[str, Any] = error.get("ctx", {})
    if kind == "model_type" and context.get("class_name") == SecretDocument.__name__:
        return _REFERENCE
    if kind in _KINDS:
        return _KINDS[kind]
    if kind in _BOUNDS:
        words, key = _BOUNDS[kind]
        return f"{words} {context[key]:.15g}"
    if kind == "string_pattern_mismatch":
        return _PATTERNS.get(context["pattern"], f"text that matches {context['pattern']}")
    if "expected" in context:
        expected = str(context["expected"])
        return "one of " + expected.replace("' or '", "', '") if kind == "enum" else expected
    return error["msg"]


def _found(root: MappingNode, path: tuple[int | str, ...], kind: str) -> str:
    tree: Tree | None = root
    for part in path:
        tree = None if tree is None else child(tree, part)
    if tree is None:
        return ""
    is_secret = any(part in _SECRET_KEYS for part in path)
    if isinstance(tree, MappingNode) and tree.values and not is_secret and kind not in _CONTAINERS:
        # a rule of several keys: `{rule: network + x}`, or the settings of a thin link
        return "{" + ", ".join(printable(_entry_text(key, value)) for key, value in tree.values.items()) + "}"
    if not isinstance(tree, Scalar) or tree.is_null or is_secret or kind in _CONTAINERS:
        return describe(tree)
    return f"'{printable(tree.text)}'" if tree.is_plain else f'"{printable(tree.text)}" in quotes'


def _entry_text(key: str, value: Tree) -> str:
    is_shown = isinstance(value, Scalar) and key not in _SECRET_KEYS
    return f"{key}: {value.text}" if is_shown and isinstance(value, Scalar) else f"{key}: ..."


def allowed_values(error: ErrorDetails) -> list[str]:
    """The values that a field allows, if the error is a value that is none of them; else empty."""
    expected = str(error.get("ctx", {}).get("expected", "")) if error["type"] == "enum" else ""
    return [word for word in expected.split("'") if word.strip(", or")]


def _enum_hint(root: MappingNode, path: tuple[int | str, ...], error: ErrorDetails) -> str:
    found = _found(root, path, "enum").strip("'")
    meant = _OTHER_VALUES.get(str(path[-1]), {}).get(found.lower().replace(" ghz", "ghz"), "")
    return suggestion((meant,)) if meant else did_you_mean(found, allowed_values(error))


def _unit_hint(root: MappingNode, path: tuple[int | str, ...]) -> str:
    """For a number with a unit (`20 dBm`, `2.5s`): what the key's name says about it."""
    tree: Tree | None = root
    for part in path:
        tree = None if tree is None else child(tree, part)
    if not isinstance(tree, Scalar):
        return ""
    if path[-1] in _SHARES and (percent := _PERCENT.fullmatch(tree.text)) is not None and float(percent[1]) > 1:
        return f"a share from 0 to 1: {percent[1]} % is {float(percent[1]) / 100:g}"
    if _DECIMAL_COMMA.fullmatch(tree.text):
        return f"write a point: {tree.text.replace(',', '.')}"
    if tree.is_plain and tree.text.lower() in ("none", "no", "off") and path[-1] in ("gateway", "lan_filter", "mesh"):
        return "write `null` to remove the value of an earlier layer"
    if path[-1] == "env" and tree.text.startswith("$"):
        return "write the variable's name alone, without `$`"
    if not _WITH_UNIT.fullmatch(tree.text):
        return ""
    unit = next((unit for suffix, unit in _UNITS.items() if str(path[-1]).endswith(suffix)), "")
    return f"write the number alone; it is in {unit}" if unit else ""


def _known_keys(path: Iterable[int | str]) -> list[str]:
    """The keys of the model at `path`."""
    kind: Any = InventoryDocument
    for part in path:
        kind = step_into(kind, part)
    model = model_of(kind)
    return [] if model is None else [field.alias or name for name, field in model.model_fields.items()]


def step_into(kind: Any, part: int | str) -> Any:
    """The type one path part further down."""
    model = model_of(kind)
    if model is not None:
        for name, field in model.model_fields.items():
            if (field.alias or name) == part:
                return field.annotation
        return None
    bare = _bare(kind)
    arguments = [argument for argument in get_args(bare) if argument is not Ellipsis]
    return arguments[-1] if arguments else None


def model_of(kind: Any) -> type[BaseModel] | None:
    """The model of a field's type; None for a list, a dictionary or a value."""
    bare = _bare(kind)
    return bare if isinstance(bare, type) and issubclass(bare, BaseModel) else None


def _bare(kind: Any) -> Any:
    while get_origin(kind) in (Annotated, Union, UnionType):
        kind = get_args(kind)[0]
    return kind
