"""Private keys: parsed once per process for all nodes, and again when the file changed."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from paramiko.pkey import PKey

from meshctl.device.authentication import load_key
from meshctl.errors import InputError
from meshctl.model import Secret
from tests.meshctl.device.servers import keypair, make_key


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files parsed, in order."""
    files: list[Path] = []
    from_path = PKey.from_path

    def parse(path: Path, passphrase: str | None = None) -> PKey:
        files.append(path)
        return from_path(path, passphrase)

    monkeypatch.setattr(PKey, "from_path", parse)
    return files


def test_threads_that_start_together_parse_a_key_file_once(tmp_path: Path, parsed: list[Path]) -> None:
    path = keypair(tmp_path / "operator", "rsa")
    with ThreadPoolExecutor(8) as pool:
        keys = list(pool.map(lambda _: load_key(path, None), range(24)))
    assert parsed == [path]
    assert all(key is keys[0] for key in keys)


def test_a_replaced_key_file_is_parsed_again(tmp_path: Path, parsed: list[Path]) -> None:
    path = keypair(tmp_path / "operator")
    before = load_key(path, None).asbytes()
    path.unlink()
    make_key(path, "ed25519")
    assert load_key(path, None).asbytes() != before
    path.unlink()
    with pytest.raises(InputError, match="operator: key file not found"):
        load_key(path, None)
    assert parsed[:2] == [path, path]


def test_a_key_cached_with_its_passphrase_still_requires_it(tmp_path: Path, parsed: list[Path]) -> None:
    path = keypair(tmp_path / "operator", passphrase="open sesame")
    load_key(path, Secret("open sesame"))
    load_key(path, Secret("open sesame"))
    assert parsed == [path]
    with pytest.raises(InputError, match="needs a passphrase"):
        load_key(path, None)


@pytest.mark.parametrize(
    ("name", "content", "fault", "hint"),
    [
        ("key", "nonsense", "is not a private key in OpenSSH or PEM format", "ssh-keygen -t ed25519"),
        ("key.pub", "ssh-ed25519 AAAA me@laptop", "is a public key", "name the private key: "),
        ("key", "ssh-ed25519 AAAA me@laptop", "is a public key", "name the private key"),
        ("key", None, "cannot be read as a private key: Is a directory", ""),
    ],
)
def test_what_is_no_private_key_is_named(name: str, content: str | None, fault: str, hint: str, tmp_path: Path) -> None:
    """The message was the library's: `Unable to load PEM file. See https://cryptography.io/... MalformedFraming`."""
    path = tmp_path / name
    if content is None:
        path.mkdir()
    else:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=fault) as raised:
        load_key(path, None)
    assert hint in raised.value.hint
    assert "cryptography" not in str(raised.value)
