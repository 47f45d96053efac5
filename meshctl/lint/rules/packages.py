"""Names of packages (MC836)."""

from __future__ import annotations

import re
from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.encryption import packages_path
from meshctl.model import Fleet

# opkg's and apk's names; a hyphen in front removes the package from the image
_NAME = re.compile(r"-?[A-Za-z0-9][A-Za-z0-9+._-]*", re.ASCII)


@fleet_rule(
    "MC836",
    Severity.ERROR,
    "An entry of `packages` is not one package's name",
    why="""The ImageBuilder takes such an entry apart or fails on it, and the node's package manager finds no package of
    that name: the image lacks what the entry was meant to add.""",
    fix="""Write one name per entry, separated by commas, without a version: the ImageBuilder's feeds decide that. Use
    `package_files` for a package of your own.""",
    failing='hardware: {rocket: {packages: ["kmod-batman-adv batctl-default", iw, wpad-openssl]}}',
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl]}}",
)
def package_of_no_name(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        for written in (*node.hardware.packages, *node.packages):
            if _NAME.fullmatch(written) is None:
                path = packages_path(node, written)
                yield Finding(path, "not the name of one package", "one name, such as kmod-batman-adv", written)
