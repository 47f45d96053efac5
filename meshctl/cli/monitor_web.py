"""Where and for whom `meshctl monitor` serves its page: its options, checked."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from meshctl.errors import InputError
from meshctl.monitor.access import TOKEN_VARIABLE, AccessRules, host_of, is_loopback
from meshctl.monitor.serve import Certificate, check_certificate, is_address

_TOKEN_BYTES = 18
MIN_TOKEN = 16


@dataclass(frozen=True, slots=True)
class WebOptions:
    """An address that is not this machine's own has a token or a certificate; actions need a token everywhere."""

    host: str
    port: int
    token: str
    certificate: Certificate | None
    host_names: frozenset[str]
    is_local: bool
    allow_actions: bool

    @property
    def rules(self) -> AccessRules:
        return AccessRules(self.token, self.host_names, accept_addresses=not self.is_local)

    @classmethod
    def checked(
        cls,
        host: str,
        port: int,
        token_file: Path | None,
        certificate: Path | None,
        key: Path | None,
        host_names: Iterable[str],
        *,
        allow_actions: bool,
    ) -> WebOptions:
        """Raises InputError."""
        if not is_address(host):
            raise InputError(f"--listen: expected an IP address, found {host!r}", hint="for example 0.0.0.0 for all")
        if (certificate is None) != (key is None):
            raise InputError("expected --tls-cert and --tls-key together")
        pair = None if certificate is None or key is None else Certificate(certificate, key)
        if pair is not None:
            check_certificate(pair)
        token = _token(token_file)
        is_local = is_loopback(host)
        # any program or web page on this machine reaches loopback
        if not token and (allow_actions or (not is_local and pair is None)):
            token = secrets.token_urlsafe(_TOKEN_BYTES)
        names = frozenset(host_of(name) for name in host_names)
        return cls(host, port, token, pair, names, is_local, allow_actions)


def _token(file: Path | None) -> str:
    """The operator's token, empty for none."""
    if file is None:
        token, where = os.environ.get(TOKEN_VARIABLE, ""), f"${TOKEN_VARIABLE}"
        if not token:
            return ""
    else:
        where = str(file)
        try:
            token = file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"cannot read {file}: {getattr(error, 'strerror', None) or error}") from error
    if len(token) < MIN_TOKEN or not token.isascii() or not token.isprintable() or " " in token:
        raise InputError(
            f"{where}: expected a token of at least {MIN_TOKEN} printable ASCII characters without spaces",
            hint=f"for example: head -c {_TOKEN_BYTES} /dev/urandom | base64 > token",
        )
    return token
