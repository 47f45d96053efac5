"""The operator's own SSH public key."""

from __future__ import annotations

from pathlib import Path

from meshctl.errors import InputError

# ssh-keygen's default files; ed25519 first, which every release but 19.07 supports.
_PUBLIC_KEYS = ("id_ed25519.pub", "id_ecdsa.pub", "id_rsa.pub")


def own_public_key(path: Path | None) -> str:
    """The text of `path`, or of the first default public key; empty if there is none."""
    candidates = [path] if path is not None else [Path("~/.ssh", name).expanduser() for name in _PUBLIC_KEYS]
    for candidate in candidates:
        if path is None and not candidate.is_file():
            continue
        try:
            text = candidate.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as reason:
            raise InputError(f"cannot read public key {candidate}: {reason}") from reason
        if "PRIVATE KEY" in text or len(text.splitlines()) != 1 or not text.startswith(("ssh-", "ecdsa-", "sk-")):
            raise InputError(f"{candidate} is not an SSH public key", hint="give the file that ends in .pub")
        return text
    return ""
