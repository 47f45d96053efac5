"""Kernel modules and their dependencies in loading order, read from the modules themselves, as depmod does."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from meshlab.errors import LabError

# in this order: batman-adv needs crc32c and encryption needs ciphers, neither of which is a declared dependency
MODULES = (
    "crc32c_generic", "virtio_pci", "virtio_net", "af_packet", "bridge", "veth",
    "aes_generic", "ctr", "ccm", "cmac", "gcm", "mac80211_hwsim", "batman-adv",
    "sch_netem", "sch_htb", "sch_ingress", "cls_flower", "cls_matchall", "act_gact", "act_mirred", "ifb",
    "nf_tables", "nft_meta_bridge", "nft_counter",
)  # fmt: skip
_DEPENDS = re.compile(rb"\0depends=([^\0]*)\0")


def in_order(modules: Path, names: Iterable[str] = MODULES) -> list[Path]:
    """The files to load below `modules` (lib/modules/VERSION), dependencies first.

    Modules that are built in or missing (ciphers move between modules) are skipped. Raises LabError when
    mac80211_hwsim is missing.
    """
    files = {_canonical(path.name.split(".")[0]): path for path in modules.rglob("*.ko*")}
    found: dict[str, Path] = {}

    def visit(name: str) -> None:
        path = files.get(name)
        if path is None or name in found:
            return
        content = path.read_bytes()
        match = _DEPENDS.search(content)
        for needed in match[1].decode().split(",") if match else ():
            if needed:
                visit(_canonical(needed))
        found[name] = path

    for name in names:
        visit(_canonical(name))
    if "mac80211_hwsim" not in found:
        raise LabError(f"the kernel in {modules} has no mac80211_hwsim", hint="use Debian's kernel")
    return list(found.values())


def _canonical(name: str) -> str:
    return name.replace("-", "_")
