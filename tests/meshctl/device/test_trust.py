"""Pins: the fleet's file means what OpenSSH's known_hosts means, keeps what it does not concern, yields to no one."""

from __future__ import annotations

import base64
import subprocess
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.device.connection import Endpoint
from meshctl.device.errors import HostKeyChanged, HostKeyUnknown
from meshctl.device.trust import HostKey, Pin, TrustStore, dump_pins, parse_key, parse_pins
from meshctl.errors import InputError

B03 = Endpoint("10.42.0.13", identity="b03")


def key(seed: int, key_type: str = "ssh-ed25519") -> HostKey:
    kind = key_type.encode()
    return HostKey(key_type, len(kind).to_bytes(4, "big") + kind + b"\0\0\0\x20" + bytes([seed]) * 32)


def store(tmp_path: Path, text: str = "") -> TrustStore:
    path = tmp_path / "fleet" / "known_hosts"
    if text:
        path.parent.mkdir()
        path.write_text(text)
    return TrustStore(path)


names = st.from_regex(r"[a-z0-9.\[\]:-]{1,20}", fullmatch=True)
pins = st.builds(
    Pin,
    names=st.lists(names, min_size=1, max_size=3).map(tuple),
    key=st.integers(0, 255).map(key),
    marker=st.sampled_from(["", "@revoked"]),
)


@given(st.lists(pins).map(tuple))
def test_dumped_pins_round_trip(wanted: tuple[Pin, ...]) -> None:
    assert parse_pins(dump_pins(wanted)) == wanted


@given(st.text())
def test_arbitrary_text_yields_pins_or_an_input_error_naming_the_source(text: str) -> None:
    try:
        parse_pins(text, source="pins")
    except InputError as error:
        assert str(error).startswith("pins:")


def test_a_fingerprint_is_the_one_ssh_keygen_shows(tmp_path: Path) -> None:
    path = tmp_path / "id"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", path], check=True)
    shown = subprocess.run(["ssh-keygen", "-lf", path], capture_output=True, text=True, check=True).stdout.split()[1]
    assert parse_key(path.with_suffix(".pub").read_text()).fingerprint == shown


def test_pins_are_interoperable_with_openssh_including_hashed_names(tmp_path: Path) -> None:
    path = tmp_path / "id"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", path], check=True)
    ours = parse_key(path.with_suffix(".pub").read_text())
    trust = store(tmp_path)
    trust.add("b03", ours)
    found = subprocess.run(["ssh-keygen", "-F", "b03", "-f", trust.path], capture_output=True, text=True, check=True)
    assert ours.text in found.stdout
    subprocess.run(["ssh-keygen", "-q", "-H", "-f", trust.path], capture_output=True, check=True)
    assert trust.path.read_text().startswith("|1|")
    assert trust.pinned("b03") == (ours,)
    assert trust.pinned("b04") == ()


def test_unknown_and_changed_host_keys_are_rejected(tmp_path: Path) -> None:
    trust = store(tmp_path)
    with pytest.raises(HostKeyUnknown):
        trust.check(B03, key(1))
    trust.add("b03", key(1))
    trust.check(B03, key(1))
    with pytest.raises(HostKeyChanged, match=r"b03 .*changed") as caught:
        trust.check(B03, key(2))
    assert caught.value.pinned == (key(1).fingerprint,)
    assert "`meshctl trust b03 --replace`" in caught.value.hint


def test_a_node_may_have_several_key_types_but_an_unpinned_type_is_rejected(tmp_path: Path) -> None:
    trust = store(tmp_path)
    trust.add("b03", key(1), key(2, "ssh-rsa"))
    trust.check(B03, key(2, "ssh-rsa"))
    with pytest.raises(HostKeyChanged):
        trust.check(B03, key(3, "ecdsa-sha2-nistp256"))


def test_pins_are_keyed_by_node_name_and_survive_an_address_change(tmp_path: Path) -> None:
    trust = store(tmp_path)
    trust.add("b03", key(1))
    trust.check(Endpoint("192.168.1.1", identity="b03"), key(1))
    with pytest.raises(HostKeyUnknown):
        trust.check(Endpoint("10.42.0.13", identity="b04"), key(1))


def test_an_endpoint_without_a_name_is_matched_by_address_as_in_openssh(tmp_path: Path) -> None:
    trust = store(tmp_path, f"[127.0.0.1]:2222,127.0.0.1 {key(1).text}\n")
    trust.check(Endpoint("127.0.0.1", port=2222), key(1))
    trust.check(Endpoint("127.0.0.1"), key(1))


def test_a_revoked_key_is_refused_even_where_it_is_pinned(tmp_path: Path) -> None:
    trust = store(tmp_path, f"b03 {key(1).text}\n@revoked * {key(2).text}\n".replace("* ", "any "))
    trust.check(B03, key(1))
    trust.add("b03", key(2))
    with pytest.raises(HostKeyChanged, match="revoked"):
        trust.check(B03, key(2))
    assert trust.pinned("b03") == (key(1),)


def test_replacing_a_pin_leaves_all_other_names_unchanged(tmp_path: Path) -> None:
    trust = store(tmp_path, f"b03,b04 {key(1).text}\nb05 {key(5).text}\n")
    trust.replace("b03", key(2))
    assert trust.pinned("b03") == (key(2),)
    assert trust.pinned("b04") == (key(1),)
    assert trust.pinned("b05") == (key(5),)
    trust.forget("b03")
    assert trust.pinned("b03") == ()
    assert trust.pinned("b04") == (key(1),)


def test_keys_pinned_in_the_inventory_count_as_pins(tmp_path: Path) -> None:
    trust = TrustStore(tmp_path / "pins", inventory={"b03": (key(1).text,)})
    trust.check(B03, key(1))
    with pytest.raises(HostKeyChanged):
        trust.check(B03, key(2))
    with pytest.raises(InputError, match="host key of b04"):
        TrustStore(tmp_path / "pins", inventory={"b04": ("ssh-ed25519 nonsense",)})


def test_the_file_is_parsed_once_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed: list[str] = []

    def parse(text: str, *, source: str) -> tuple[Pin, ...]:
        parsed.append(text)
        return parse_pins(text, source=source)

    trust = store(tmp_path, f"b03 {key(1).text}\n")
    monkeypatch.setattr("meshctl.device.trust.parse_pins", parse)
    for _ in range(3):
        assert trust.known(B03) == (key(1),)
        trust.check(B03, key(1))
    assert len(parsed) == 1
    with trust.path.open("a") as file:
        file.write(f"@revoked b04 {key(1).text}\n")
    with pytest.raises(HostKeyChanged, match="revoked"):
        trust.check(B03, key(1))
    trust.path.write_text(f"b03 {key(2).text}\n")
    trust.check(B03, key(2))
    trust.path.unlink()
    assert trust.known(B03) == ()


def test_keys_are_returned_in_file_order_including_hashed_names(tmp_path: Path) -> None:
    path = tmp_path / "hashed"
    path.write_text(f"b03 {key(2).text}\n")
    subprocess.run(["ssh-keygen", "-q", "-H", "-f", path], capture_output=True, check=True)
    trust = store(tmp_path, f"b03,b04 {key(1).text}\n{path.read_text()}b03 {key(3).text}\n")
    assert trust.pinned("b03") == (key(1), key(2), key(3))
    assert trust.pinned("b04") == (key(1),)


def test_many_writers_lose_no_pin(tmp_path: Path) -> None:
    trust = store(tmp_path)
    threads = [threading.Thread(target=trust.add, args=(f"b{n:02}", key(n))) for n in range(24)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {pin.names[0] for pin in trust.pins()} == {f"b{n:02}" for n in range(24)}
    assert [path.name for path in trust.path.parent.iterdir() if path.name.startswith("tmp")] == []


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("b03", "expected `TYPE BASE64`"),
        ("b03 ssh-ed25519 !!!", "expected base64"),
        (f"b03 ssh-rsa {key(1).text.split()[1]}", "not of type ssh-rsa"),
        (f"*.mesh {key(1).text}", "without patterns"),
        (f"@cert-authority b03 {key(1).text}", "@cert-authority"),
        (f"b03 ssh-ed25519 {base64.b64encode(b'ab').decode()}", "not of type"),
    ],
)
def test_an_invalid_line_is_rejected_with_its_line_number(line: str, said: str, tmp_path: Path) -> None:
    trust = store(tmp_path, f"# the fleet\n\n{line}\n")
    with pytest.raises(InputError, match=r"known_hosts:3: ") as caught:
        trust.check(B03, key(1))
    assert said in str(caught.value)


def test_a_directory_in_place_of_the_file_is_named_in_words(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        TrustStore(tmp_path).pinned("b01")
    assert str(caught.value) == f"{tmp_path}: cannot read the pinned host keys: Is a directory"
    assert "operators.known_hosts" in caught.value.hint
