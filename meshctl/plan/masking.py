"""Keep secrets out of what is shown and stored.

`masked_text` is a package's text with its secrets replaced. `Fingerprints` hashes text in which every secret is first
replaced by its scrypt hash, so that guessing passphrases against a saved plan is slow.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from threading import Lock

from meshctl.model import MASK
from meshctl.uci import Package, Section, Value, dump, is_secret

# Cost of one guess (RFC 7914 section 2: N, r, p): about 50 ms and 16 MiB on a laptop.
_SCRYPT_N, _SCRYPT_R, _SCRYPT_P = 2**14, 8, 1


def secrets_of(package: Package) -> tuple[str, ...]:
    """The secrets in a package, longest first, so that replacing them in order leaves no part of any."""
    found = {
        item
        for section in package.sections
        for option, value in section.options.items()
        if is_secret(option, value)
        for item in ((value,) if isinstance(value, str) else value)
    }
    return tuple(sorted(found, key=lambda secret: (-len(secret), secret)))


def masked_text(package: Package, *, differing_from: Package | None = None) -> str:
    """Canonical text with secrets masked; a secret that differs from the one in `differing_from` is marked."""

    def mask(section: Section) -> Section:
        other = _counterpart(section, package, differing_from)

        def value_of(option: str, value: Value) -> Value:
            if not is_secret(option, value):
                return value
            return f"{MASK} (another)" if other is not None and other.options.get(option, value) != value else MASK

        return Section(section.type, section.name, {key: value_of(key, text) for key, text in section.options.items()})

    return dump(Package(package.name, tuple(mask(section) for section in package.sections)))


def _counterpart(section: Section, package: Package, other: Package | None) -> Section | None:
    if other is None:
        return None
    if section.name is not None:
        return other.section(section.name)
    alike = [found for found in package.of_type(section.type) if found.name is None]
    others = [found for found in other.of_type(section.type) if found.name is None]
    index = alike.index(section)
    return others[index] if index < len(others) else None


class Fingerprints:
    """Salted hashes of texts with secrets, one salt for each plan. Each secret costs one scrypt, once."""

    def __init__(self, salt: bytes) -> None:
        self.salt = salt
        self._digests: dict[str, str] = {}
        self._lock = Lock()

    def secret(self, value: str) -> str:
        """A stand-in for a secret: equal for equal secrets under this salt, and slow to compute."""
        with self._lock:
            if value not in self._digests:
                digest = hashlib.scrypt(value.encode(), salt=self.salt, n=_SCRYPT_N, r=_SCRYPT_R, p=_SCRYPT_P, dklen=32)
                self._digests[value] = digest.hex()
            return self._digests[value]

    def of(self, texts: Mapping[str, str], secrets: Iterable[str] = ()) -> str:
        """One hash over named texts in any order, with every occurrence of `secrets` replaced."""
        longest_first = sorted({secret for secret in secrets if secret}, key=lambda secret: (-len(secret), secret))
        digest = hashlib.sha256(self.salt)
        for name in sorted(texts):
            text = texts[name]
            for secret in longest_first:
                if secret in text:
                    text = text.replace(secret, self.secret(secret))
            for part in (name, text):
                encoded = part.encode("utf-8", "surrogateescape")
                digest.update(len(encoded).to_bytes(8, "big") + encoded)
        return digest.hexdigest()
