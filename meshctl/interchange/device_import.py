"""Import one device: entries, rendering, comparison, and what to write. Pure but for `Inventory.load`.

A first pass finds the options that only the device has, a second one renders the entry with them, so that what is
reported is what provisioning would change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

from meshctl.interchange.device import ExistingDevice
from meshctl.interchange.device_differences import Comparison, Difference, Fate, compare
from meshctl.interchange.device_entries import Entries, ImportOptions, Path, entries_of
from meshctl.inventory.yaml_text import Value
from meshctl.model import Fleet, Node, Secret, SecretRef
from meshctl.render import Templates, render_node
from meshctl.uci import Package

# the inventory with these entries set; raises InvalidInput for one that would have errors
Load = Callable[[Mapping[Path, Value]], Fleet]


@dataclass(frozen=True, slots=True)
class DeviceImport:
    """The edits for one device, and the fate of its configuration."""

    name: str
    values: Mapping[Path, Value]
    secrets: Mapping[str, Secret] = field(repr=False)
    fleet: Fleet = field(repr=False)
    kept: Mapping[str, str]
    differences: tuple[Difference, ...]
    untouched: tuple[str, ...]
    unreadable: tuple[str, ...]
    """The error of a file that is not UCI and that meshctl does not write."""
    assumed: tuple[str, ...]

    def of(self, fate: Fate) -> tuple[Difference, ...]:
        return tuple(each for each in self.differences if each.fate is fate)


def import_device(
    device: ExistingDevice,
    fleet: Fleet | None,
    options: ImportOptions,
    load: Load,
    secrets: Callable[[SecretRef], Secret],
    *,
    keep: Iterable[str] = (),
) -> DeviceImport:
    """Import `device` into the inventory of `fleet`, or into a new one (None). `secrets` reads those of `fleet`.

    Raises InputError, and InvalidInput for values that an inventory cannot have, and for a file that meshctl writes and
    that is not UCI on the device.
    """
    entries = entries_of(device, fleet, options)
    patterns = tuple(keep)

    def find(ref: SecretRef) -> Secret:
        own = entries.secrets.get(ref.where)
        return own if own is not None else secrets(ref)

    entries = _concise(entries, fleet, load)
    loaded = load(entries.values)
    first = _compare(device, loaded, entries, find, patterns)
    if first.extra_uci:
        entries = _with_extra(entries, first.extra_uci)
        loaded = load(entries.values)
    final = _compare(device, loaded, entries, find, patterns) if first.extra_uci else first
    return DeviceImport(
        name=entries.name,
        values=entries.values,
        secrets=entries.secrets,
        fleet=loaded,
        kept=first.extra_uci,
        differences=final.differences,
        untouched=final.untouched,
        unreadable=tuple(str(item) for items in device.unreadable.values() for item in items),
        assumed=entries.assumed,
    )


def _compare(
    device: ExistingDevice,
    fleet: Fleet,
    entries: Entries,
    secrets: Callable[[SecretRef], Secret],
    keep: tuple[str, ...],
) -> Comparison:
    rendered = render_node(fleet, entries.name, secrets, Templates.of(fleet), device.facts)
    packages: dict[str, Package] = {
        file.package.name: file.package for file in rendered.files if file.package is not None
    }
    device.require(packages)
    return compare(device.packages, packages, entries.sections, keep=keep)


def _with_extra(entries: Entries, extra: Mapping[str, str]) -> Entries:
    path = ("nodes", entries.name)
    node = entries.values[path]
    assert isinstance(node, Mapping)
    return replace(entries, values={**entries.values, path: {**node, "extra_uci": dict(extra)}})


# keys that an entry may leave to `defaults` and groups, with the node's value
_INHERITED: Mapping[str, Callable[[Node], object]] = {
    "hardware": lambda node: node.hardware.name,
    "role": lambda node: node.role.value,
    "state": lambda node: node.state.value,
    "gateway": lambda node: str(node.gateway),
}


def _concise(entries: Entries, fleet: Fleet | None, load: Load) -> Entries:
    """The entry without the values that it inherits anyway."""
    path = ("nodes", entries.name)
    node = entries.values[path]
    assert isinstance(node, Mapping)
    if fleet is None:
        return entries
    bare = {key: value for key, value in node.items() if key in ("groups", "hardware", "address")}
    inherited = load({**entries.values, path: bare}).nodes[entries.name]
    kept = {
        key: value
        for key, value in node.items()
        if key in ("hardware",) or key not in _INHERITED or _INHERITED[key](inherited) != value
    }
    radios = node.get("radios")
    if isinstance(radios, Mapping):
        own = {radio.name: radio for radio in inherited.radios}
        changed = {
            name: settings
            for name, values in radios.items()
            if isinstance(values, Mapping)
            and (settings := {
                key: value
                for key, value in values.items()
                if name not in own or value != (own[name].mesh if key == "mesh" else own[name].tx_power_dbm)
            })
        }  # fmt: skip
        kept = {key: value for key, value in kept.items() if key != "radios"}
        if changed:
            kept["radios"] = changed
    return replace(entries, values={**entries.values, path: kept})
