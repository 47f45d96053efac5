"""A copy of an inventory for its virtual twin: the same fleet, with a login key made for this fleet alone.

The user's inventory stays as it is. `prepare` copies its files into `DIRECTORY/inventory`, makes a key pair in
`DIRECTORY/keys`, and writes the public key and the key file's path into the copy.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from meshctl.errors import InputError
from meshctl.inventory import load_fleet
from meshctl.inventory.edit import Editor, save
from meshctl.lab import ground_file
from meshctl.lab.ground import links_of
from meshctl.lab.spec import LinkSpec
from meshctl.model import Fleet

# beside fleet.yaml, if the fleet's own shape matters
LINKS_FILE = "links.yaml"
_KEY_COMMENT = "lab-operator"


@dataclass(frozen=True, slots=True)
class Copy:
    """The copied inventory's path, what it says, its login key, and the links file's content (None: no file)."""

    inventory: Path
    fleet: Fleet
    key_file: Path
    links: list[LinkSpec] | None


def prepare(source: Path, directory: Path, *, environ: Mapping[str, str] = os.environ) -> Copy:
    """Copy the inventory `source` (a file or a directory) into `directory`; a key that is there is kept.

    Raises InvalidInput with the diagnostics of an inventory that has errors, InputError when files cannot be copied.
    """
    fleet = load_fleet(source, environ=environ)
    folder = source if source.is_dir() else source.parent
    target = directory / "inventory"
    try:
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(folder, target)
    except (OSError, shutil.Error) as error:
        raise InputError(f"{folder} cannot be copied to {target}: {error}") from error
    copied = target if source.is_dir() else target / source.name
    key_file = directory / "keys" / "operator"
    public = _key_pair(key_file)
    editor = Editor.open(copied, environ=environ)
    editor.set(("operators", "ssh_keys"), [*fleet.operators.ssh_keys, public])
    editor.set(("defaults", "ssh", "key_files"), [str(key_file)])
    save(editor.changes())
    links = target / LINKS_FILE
    heard = list(links_of(ground_file.load(links))) if links.exists() else None
    return Copy(copied, load_fleet(copied, environ=environ), key_file, heard)


def _key_pair(path: Path) -> str:
    """The public key's line; the pair is made when it is not there."""
    public_path = path.with_name(path.name + ".pub")
    if not (path.exists() and public_path.exists()):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        key = Ed25519PrivateKey.generate()
        path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption()))
        path.chmod(0o600)
        public = key.public_key().public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH).decode()
        public_path.write_text(f"{public} {_KEY_COMMENT}\n", encoding="ascii")
    return public_path.read_text(encoding="ascii").strip()
