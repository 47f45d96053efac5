"""Public keys are read whole or refused, and a refusal never repeats them."""

import base64
import struct

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from hypothesis import given
from hypothesis import strategies as st

from meshctl.lint.sshkey import BadKey, parse_authorized_key


def _line(key: ed25519.Ed25519PublicKey | rsa.RSAPublicKey | ec.EllipticCurvePublicKey) -> str:
    return key.public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH).decode()


def test_key_types_written_by_openssh_are_parsed() -> None:
    key = parse_authorized_key(_line(ed25519.Ed25519PrivateKey.generate().public_key()) + " alice@laptop")
    assert (key.kind, key.bits, key.comment) == ("ssh-ed25519", 256, "alice@laptop")
    key = parse_authorized_key(_line(rsa.generate_private_key(65537, 2048).public_key()))
    assert (key.kind, key.bits) == ("ssh-rsa", 2048)
    for curve, bits in ((ec.SECP256R1(), 256), (ec.SECP384R1(), 384)):
        assert parse_authorized_key(_line(ec.generate_private_key(curve).public_key())).bits == bits


def test_options_may_precede_the_key() -> None:
    line = _line(ed25519.Ed25519PrivateKey.generate().public_key())
    assert parse_authorized_key(f'no-pty,from="10.42.0.*" {line} bob').comment == "bob"


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("", "unknown key type"),
        ("hello world", "unknown key type"),
        ("-----BEGIN OPENSSH PRIVATE KEY-----", "a private key"),
        ("ssh-ed25519", "without key data"),
        ("ssh-ed25519 !!!!", "not base64"),
        ("ssh-ed25519 AAAA", "truncated"),
        ("ssh-rsa AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f", "not ssh-rsa"),
        ("ssh-rsa AAAAB3NzaC1yc2E=", "truncated"),
        ("ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAAkFC", "truncated"),
    ],
)
def test_an_invalid_or_truncated_key_is_rejected(line: str, why: str) -> None:
    with pytest.raises(BadKey, match=why):
        parse_authorized_key(line)


@given(st.binary(max_size=60), st.sampled_from(["ssh-rsa", "ssh-ed25519", "ssh-dss", "ecdsa-sha2-nistp256"]))
def test_arbitrary_bytes_parse_or_are_rejected_without_being_shown(blob: bytes, kind: str) -> None:
    inside = struct.pack(">I", len(kind)) + kind.encode() + blob
    encoded = base64.b64encode(inside).decode()
    try:
        key = parse_authorized_key(f"{kind} {encoded}")
    except BadKey as error:
        refusal = str(error)
        assert encoded not in refusal
    else:
        assert key.kind == kind
