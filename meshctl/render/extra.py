"""Apply `extra_uci` of the inventory to the rendered packages: `network.lan.mtu: "1400"`.

As with `uci set`, a key of two parts creates a section with its type as the value (`network.switch0: switch`), a key of
three parts sets an option, and an empty value removes it. Sections are created before options are set.
"""

from __future__ import annotations

from collections.abc import Mapping

from meshctl.diagnostics import Diagnostic, InvalidInput, Severity
from meshctl.resolve import Intent
from meshctl.suggest import did_you_mean
from meshctl.uci import Package, Section

# Options that cannot be set (docs/render.md).
EXTRA = "RND013"
_HINT = "correct this key of extra_uci: PACKAGE.SECTION creates a section, PACKAGE.SECTION.OPTION sets an option"


def with_extra(packages: Mapping[str, Package], intent: Intent) -> dict[str, Package]:
    """The packages with `intent.extra_uci` applied, new ones last. Raises InvalidInput with all invalid keys."""
    result = dict(packages)
    failed: list[Diagnostic] = []
    for key, value in sorted(intent.extra_uci.items(), key=lambda item: item[0].count(".")):
        name, _, rest = key.partition(".")
        package = result.get(name, Package(name))
        section, _, option = rest.partition(".")
        try:
            result[name] = _set_option(package, section, option, value) if option else _make(package, section, value)
        except ValueError as error:
            place = intent.extra_positions.get(key, intent.position)
            message = f"cannot be set: {error}"
            hint = _hint(package, section) if option else _HINT
            failed.append(Diagnostic(EXTRA, Severity.ERROR, place, message, f"extra_uci.{key}", hint=hint))
    if failed:
        raise InvalidInput(failed)
    return result


def _hint(package: Package, section: str) -> str:
    """For an option of a section that is not there: how to create it, and the names of similar ones."""
    keys = package.keys()
    if f"@{section}[0]" in keys:
        return f"did you mean '@{section}[0]'?"
    near = did_you_mean(section, [key for key in keys if not key.startswith("@")])
    create = f"create the section with a key of its own, `{package.name}.{section}: TYPE`"
    return f"{create}, or correct the name: {near}" if near else f"{create}, or correct the name"


def _make(package: Package, name: str, type_name: str) -> Package:
    known = package.section(name)
    if known is None:
        return Package(package.name, (*package.sections, Section(type_name, name)))
    if known.type != type_name:
        raise ValueError(f"expected a section of type {known.type!r} as rendered, found {type_name!r}")
    return package


def _set_option(package: Package, key: str, option: str, value: str) -> Package:
    keys = package.keys()
    if key not in keys:
        raise ValueError(f"expected a section of {package.name} ({', '.join(keys) or 'which has none'}), found {key!r}")
    index = keys.index(key)
    old = package.sections[index]
    options = {name: before for name, before in old.options.items() if name != option or value}
    if value:
        options[option] = value
    sections = (*package.sections[:index], Section(old.type, old.name, options), *package.sections[index + 1 :])
    return Package(package.name, sections)
