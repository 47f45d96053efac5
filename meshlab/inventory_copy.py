"""A copy of an inventory for a virtual fleet, with a login key for this fleet only.

The user's inventory is not changed. `copy_inventory` claims DIRECTORY for the lab, copies the inventory's files into
`DIRECTORY/inventory`, generates a key pair in `DIRECTORY/keys`, and writes the public key and the key file's path into
the copy. The copy has its own known_hosts: the original's is neither copied nor written. Robots' computers that the
original reaches by an `ssh.host` have none in the copy: `meshctl robots` would deploy to the real robots.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.rsa import generate_private_key
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from meshctl.fleet.lab_directory import INVENTORY, KEY_COMMENT, lab_of
from meshctl.fleet.lab_sites import is_this_machine
from meshctl.inventory import load_fleet
from meshctl.inventory.edit import Editor, save
from meshctl.model import Fleet, Release
from meshlab import fleet_directory, propagation_file
from meshlab.outside_files import bring_outside_files
from meshlab.propagation import links_of
from meshlab.spec import LinkSpec

# beside fleet.yaml, optional: the links of the virtual fleet
LINKS_FILE = "links.yaml"
# beside the copy, whatever file the original uses: host keys of virtual nodes must not mix with real ones
_KNOWN_HOSTS = "known_hosts"
# as ssh-keygen makes them
_RSA_BITS, _RSA_EXPONENT = 3072, 65537


@dataclass(frozen=True, slots=True)
class InventoryCopy:
    """The copied inventory's path, its fleet, its login key, and the content of the links file (None: no file).

    `kept` is the new path of an earlier copy with edits, None when there was none. `hosts` are the values of
    `ssh.host` that are not in the copy.
    """

    inventory: Path
    fleet: Fleet
    key_file: Path
    links: list[LinkSpec] | None
    kept: Path | None = None
    hosts: tuple[str, ...] = ()


def copy_inventory(source: Path, directory: Path, *, environ: Mapping[str, str] = os.environ) -> InventoryCopy:
    """Copy the inventory `source` (a file or a directory) into `directory`; an existing key pair is reused.

    `source` may be the earlier copy. Raises InvalidInput for an inventory with errors, LabError when `directory` has
    other contents or a running fleet, InputError when copying fails; nothing is replaced then.
    """
    fleet = load_fleet(source, environ=environ)
    # the copy names the key file, and relative paths in it would start at the copy
    directory = directory.absolute()
    folder = source if source.is_dir() else source.parent
    fleet_directory.claim(directory)
    kept = fleet_directory.replace_inventory(folder, directory, without=(_KNOWN_HOSTS, f".{_KNOWN_HOSTS}.lock"))
    target = directory / INVENTORY
    copied = target if source.is_dir() else target / source.name
    key_file = directory / "keys" / "operator"
    needs_rsa = any(node.release is Release.V19_07 for node in fleet.nodes.values())
    public = _key_pair(key_file, needs_rsa=needs_rsa)
    bring_outside_files(source, folder, target, fleet, environ)
    editor = Editor.open(copied, environ=environ)
    editor.set(("operators", "ssh_keys"), list(dict.fromkeys([*fleet.operators.ssh_keys, public])))
    editor.set(("defaults", "ssh", "key_files"), [str(key_file)])
    if fleet.operators.known_hosts != _KNOWN_HOSTS:
        place = ("operators", "known_hosts")
        is_beside = Path(fleet.where(*place).position.file).parent == folder
        editor.set(place, _KNOWN_HOSTS if is_beside else str(target / _KNOWN_HOSTS))
    # a lab's own copy has those of test machines, which the user has set there
    hosts = () if lab_of(str(source.resolve())) else tuple(_without_hosts(editor, fleet))
    save(editor.changes())
    fleet_directory.record_digests(directory)
    links = target / LINKS_FILE
    link_specs = list(links_of(propagation_file.load(links))) if links.exists() else None
    return InventoryCopy(copied, load_fleet(copied, environ=environ), key_file, link_specs, kept, hosts)


def _without_hosts(editor: Editor, fleet: Fleet) -> Iterator[str]:
    """Remove the `ssh.host` of robots' computers on other machines; yields each."""
    for robot in fleet.robots.values():
        for place, _, computer in robot.all_computers():
            if computer.ssh.host and not is_this_machine(computer.ssh.host):
                editor.set(("robots", robot.name, *place, "ssh", "host"), "")
                yield computer.ssh.host


def _key_pair(path: Path, *, needs_rsa: bool) -> str:
    """The public key's line; the pair is generated if missing. OpenWrt 19.07 accepts RSA only."""
    public_path = path.with_name(path.name + ".pub")
    is_usable = path.exists() and public_path.exists()
    if needs_rsa:
        is_usable = is_usable and public_path.read_text(encoding="ascii").startswith("ssh-rsa ")
    if not is_usable:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        key = generate_private_key(_RSA_EXPONENT, _RSA_BITS) if needs_rsa else Ed25519PrivateKey.generate()
        path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption()))
        path.chmod(0o600)
        public = key.public_key().public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH).decode()
        public_path.write_text(f"{public} {KEY_COMMENT}\n", encoding="ascii")
    return public_path.read_text(encoding="ascii").strip()
