"""Where apt finds the machine's packages: Debian 12's own, on a host of any distribution that has apt.

The machine is made of bookworm's packages alone, so that it is the same machine everywhere. A host that is bookworm has
the sources; on any other (Ubuntu, another Debian) apt gets a list of its own, kept in the lab's cache and verified with
Debian's archive keyring, and the host's sources do not count.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

from meshlab.errors import LabError

CODENAME = "bookworm"
OS_RELEASE = Path("/etc/os-release")
# Debian's package debian-archive-keyring, which Ubuntu has, too
KEYRING = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
MIRROR = "http://deb.debian.org/debian"
# names another mirror, for networks that reach Debian through one of their own
MIRROR_VARIABLE = "MESHCTL_LAB_DEBIAN"


def codename(os_release: str) -> str:
    """What /etc/os-release calls this version of the distribution; empty when it does not say."""
    found = re.search(r'^VERSION_CODENAME="?([^"\n]*)"?$', os_release, re.MULTILINE)
    return found[1] if found else ""


def distribution(os_release: str) -> str:
    """The distribution's name for people, such as `Ubuntu 24.04.1 LTS`."""
    found = re.search(r'^PRETTY_NAME="?([^"\n]*)"?$', os_release, re.MULTILINE)
    return found[1] if found else "this distribution"


def sources(cache: Path, environ: Mapping[str, str] = os.environ, os_release: Path = OS_RELEASE) -> dict[str, str]:
    """apt's options that lead it to bookworm's packages: none where the host's own sources do; else `Dir::*` of a list
    in `cache`, which `apt-get update` has to fill. Raises LabError when apt could not verify what it fetches."""
    text = os_release.read_text(encoding="utf-8") if os_release.exists() else ""
    mirror = environ.get(MIRROR_VARIABLE, "")
    if codename(text) == CODENAME and not mirror:
        return {}
    if not KEYRING.exists():
        raise LabError(
            f"the lab's machine is made of Debian's packages ({CODENAME}), and {distribution(text)} has no {KEYRING}",
            hint="scripts/setup-lab installs it: apt install debian-archive-keyring",
        )
    lists = cache / "lists"
    (lists / "partial").mkdir(parents=True, exist_ok=True)
    listed = cache / "sources.list"
    listed.write_text(f"deb [arch=amd64 signed-by={KEYRING}] {mirror or MIRROR} {CODENAME} main\n", encoding="ascii")
    return {
        "Dir::Etc::sourcelist": str(listed),
        "Dir::Etc::sourceparts": "-",
        # of the host's preferences, none is about these packages
        "Dir::Etc::preferences": "-",
        "Dir::Etc::preferencesparts": "-",
        "Dir::State::lists": str(lists),
    }
