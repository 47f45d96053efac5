"""Credentials and certificates for a NATS server, from files."""

from __future__ import annotations

import re
import ssl
from pathlib import Path
from typing import Any

from meshctl.errors import InputError

_SEED = re.compile(r"SU[A-Z2-7]{56}")


def login_options(credentials: Path | None) -> dict[str, Any]:
    """The options of nats-py for a file of credentials. Raises InputError."""
    if credentials is None:
        return {}
    try:
        text = credentials.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{credentials}: cannot be read: {error.strerror}") from error
    if "BEGIN NATS USER JWT" in text:
        return {"user_credentials": str(credentials)}
    if not _SEED.fullmatch(text.strip()):
        raise InputError(f"{credentials}: expected a .creds file or the seed of a user's nkey (SU...)")
    return {"nkeys_seed_str": text.strip()}


def tls_context(ca: Path) -> ssl.SSLContext:
    """Trusts this certificate authority alone. Raises InputError."""
    try:
        return ssl.create_default_context(cafile=str(ca))
    except (OSError, ssl.SSLError) as error:
        raise InputError(f"{ca}: not a certificate authority: {error}") from error
