"""An existing device's configuration and the facts that an inventory needs about it, from an observation or from the
text of `uci export`. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from meshctl.device.observation import Observation, WirelessLink
from meshctl.diagnostics import Diagnostic, InvalidInput, Position, Severity
from meshctl.errors import InputError
from meshctl.model import RELEASES, Release
from meshctl.render import DeviceFacts, with_switch
from meshctl.render.rendered import MARKER_PATH
from meshctl.uci import Package, Section, parse, parse_export

MARKER = f"/{MARKER_PATH}"
EMPTY_EXPORT = "IMP001"
# without which there is nothing to import
_ESSENTIAL = frozenset({"network", "system", "wireless"})
# a line of `uci show`, and the first line of a package of `uci export`
_SHOWN = re.compile(r"^[a-z0-9_]+\.[@\w\[\]-]+(\.\w+)?=", re.MULTILINE)
_PACKAGE = re.compile(r"^package ", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class ExistingDevice:
    """One device. Empty text and None mean that it was not reported; `marker` is meshctl's own file on the node.
    `unreadable` are the files in /etc/config that are not UCI, with what is wrong."""

    packages: Mapping[str, Package] = field(repr=False)
    release: Release
    board: str
    target: str = ""
    lan_ports: tuple[str, ...] = ()
    switch_vlans: tuple[tuple[str, str, str], ...] = ()
    label_mac: str = ""
    memory_mib: int | None = None
    authorized_keys: tuple[str, ...] = ()
    links: tuple[WirelessLink, ...] = ()
    marker: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    unreadable: Mapping[str, tuple[Diagnostic, ...]] = field(default_factory=lambda: MappingProxyType({}))

    def require(self, packages: Iterable[str]) -> None:
        """Raises InvalidInput if one of these is unreadable."""
        problems = [item for name in packages for item in self.unreadable.get(name, ())]
        if problems:
            raise InvalidInput(problems)

    def package(self, name: str) -> Package:
        """The package, empty if the device has none."""
        return self.packages.get(name, Package(name))

    @property
    def facts(self) -> DeviceFacts:
        """Facts of the device that provisioning keeps (`meshctl.render.facts`)."""
        versions = (section.get("compat_version") for section in self.package("system").of_type("system"))
        packages = dict(self.packages)
        if "network" in packages and any("." in port for port in self.lan_ports):
            packages["network"] = with_switch(packages["network"], self.switch_vlans)
        return DeviceFacts(next(filter(None, versions), ""), packages)

    @property
    def hostname(self) -> str:
        return next((section.get("hostname") for section in self.package("system").of_type("system")), "")

    def link(self, section: Section) -> WirelessLink | None:
        """The running interface of a wifi-iface section, if its name is known."""
        names = {section.get("ifname"), section.name} - {"", None}
        return next((link for link in self.links if link.ifname in names), None)


def observed_device(observation: Observation) -> ExistingDevice:
    """The device of an observation that includes the file MARKER.

    Raises InputError if it reported no release, board or configuration, InvalidInput if its network, its
    radios or its system are not UCI.
    """
    if observation.release is None or observation.board is None or observation.uci is None:
        missing = [
            word
            for word, fact in (
                ("release", observation.release),
                ("board", observation.board),
                ("/etc/config", observation.uci),
            )
            if fact is None
        ]
        raise InputError(
            f"the device reports no {' and no '.join(missing)}", hint="it must run OpenWrt 19.07 or later, as root"
        )
    packages = {}
    unreadable: dict[str, tuple[Diagnostic, ...]] = {}
    for name, text in observation.uci.items():
        try:
            packages[name] = parse(text, f"/etc/config/{name}", name=name)
        except InvalidInput as reason:
            unreadable[name] = reason.diagnostics
    marker = observation.files.get(MARKER)
    device = ExistingDevice(
        packages=packages,
        release=release_of(observation.release.version),
        board=observation.board.board_name,
        target=observation.release.target,
        lan_ports=observation.board.lan_ports,
        switch_vlans=observation.board.switch_vlans,
        label_mac=observation.board.label_mac.lower(),
        memory_mib=None if observation.memory is None else _memory_mib(observation.memory.total),
        authorized_keys=observation.authorized_keys or (),
        links=observation.links or (),
        marker=MappingProxyType(parse_marker("" if marker is None else marker.text or "")),
        unreadable=MappingProxyType(unreadable),
    )
    device.require(_ESSENTIAL)
    return device


def exported_device(text: str, file: str, *, release: Release, board: str, target: str) -> ExistingDevice:
    """The device of a recorded `uci export`, which names neither board nor release. Raises InvalidInput."""
    try:
        packages = {package.name: package for package in parse_export(text, file)}
    except InvalidInput as reason:
        raise InvalidInput(
            [replace(each, hint=each.hint or _recording_hint(text)) for each in reason.diagnostics]
        ) from None
    if not packages:
        expected = "the output of `uci export`, which starts with `package NAME`"
        raise InvalidInput(
            [Diagnostic(EMPTY_EXPORT, Severity.ERROR, Position(file, 1), "", expected=expected, found="no package")]
        )
    return ExistingDevice(packages, release, board, target)


def _recording_hint(text: str) -> str:
    """How to record a device, if the text is no `uci export`; else nothing."""
    if _SHOWN.search(text):
        return "this is the output of `uci show`: record the device with `uci export`"
    if not _PACKAGE.search(text):
        return "record the device with `uci export`: a file of /etc/config does not name its package"
    return ""


def release_of(version: str) -> Release:
    """The release series of a version such as 24.10.2. Raises InputError for one that meshctl does not render."""
    found = re.match(r"\d\d\.\d\d", version)
    release = next((each for each in RELEASES if found is not None and each.value == found[0]), None)
    if release is None:
        known = ", ".join(each.value for each in RELEASES)
        raise InputError(
            f"OpenWrt {version or '(no version)'}: expected a release of {known}",
            hint="for a snapshot or a derived firmware, name the nearest release with --release",
        )
    return release


def parse_marker(text: str) -> dict[str, str]:
    """The lines `key=value` of the marker file."""
    pairs = (line.partition("=") for line in text.splitlines())
    return {key: value for key, separator, value in pairs if separator}


def _memory_mib(total_bytes: int) -> int:
    """The RAM's size: the kernel reports less, and sizes are powers of two."""
    size = 8
    while size * 1024 * 1024 < total_bytes:
        size *= 2
    return size
