"""The packages that a node lacks, and the package files that provide them (nodes have no internet)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from meshctl.device.observation import Observation
from meshctl.plan.values import PackageStep

# opkg: NAME_VERSION_ARCH.ipk; apk: NAME-VERSION.apk, where a version starts with a digit
_IPK = re.compile(r"(?P<name>[^_/]+)_(?P<version>[^_/]*)(_[^/]*)?\.ipk")
_APK = re.compile(r"(?P<name>[^/]+?)-(?P<version>[0-9][^/]*)\.apk")
# opkg's file names lack the epoch
_EPOCH = re.compile(r"\d+:")


@dataclass(frozen=True, slots=True)
class Needs:
    """`any_of`: one package of each group must be installed, preferably the first; `removed` must not be."""

    any_of: tuple[tuple[str, ...], ...] = ()
    removed: tuple[str, ...] = ()


NO_NEEDS = Needs()


def package_name(file: str) -> str | None:
    """`path/kmod-batman-adv_5.15-1_mips_24kc.ipk` -> `kmod-batman-adv`; None for any other file."""
    match = _parts(file)
    return None if match is None else match["name"]


def _parts(file: str) -> re.Match[str] | None:
    base = file.rpartition("/")[2]
    return _IPK.fullmatch(base) or _APK.fullmatch(base)


def other_versions(observation: Observation, files: Iterable[str]) -> tuple[str, ...]:
    """A note for each package file of another version than that which is installed: it is not installed."""
    installed = observation.packages or {}
    return tuple(
        f"{match['name']} is installed as {version}, package_files has {match['version']}: only missing packages are "
        "installed; to replace it, flash an image that contains it"
        for file in files
        if (match := _parts(file)) is not None
        and (version := _EPOCH.sub("", installed.get(match["name"], ""), count=1))
        and version != match["version"]
    )


def missing_packages(needs: Needs, observation: Observation) -> tuple[tuple[str, ...], ...]:
    """The groups of which no package is installed; empty when the installed packages are unknown."""
    if observation.packages is None:
        return ()
    return tuple(group for group in needs.any_of if not any(name in observation.packages for name in group))


def package_step(needs: Needs, observation: Observation, files: Iterable[str]) -> PackageStep | None:
    """The packages to install and remove, None when nothing is missing. All given files that are not installed are
    included, since they may be dependencies.

    A group that no file provides is in `install`, too: see `unavailable`.
    """
    missing = missing_packages(needs, observation)
    if not missing:
        return None
    installed = observation.packages or {}
    offered = {name: file for file in files if (name := package_name(file)) is not None}
    install = tuple(next((name for name in group if name in offered), group[0]) for group in missing)
    return PackageStep(
        install,
        tuple(file for name, file in offered.items() if name not in installed),
        tuple(name for name in needs.removed if name in installed),
    )


def unavailable(step: PackageStep) -> tuple[str, ...]:
    """The packages of a step that none of its files provides."""
    brought = {package_name(file) for file in step.files}
    return tuple(name for name in step.install if name not in brought)
