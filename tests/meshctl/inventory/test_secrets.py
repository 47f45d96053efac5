"""Secrets come from where a reference points, and nothing ever prints one."""

from __future__ import annotations

import json
import pickle
import traceback
from pathlib import Path

import pyrage
import pytest

from meshctl.diagnostics import Position
from meshctl.errors import InputError
from meshctl.inventory import load
from meshctl.inventory.secrets import SecretStore
from meshctl.model import Secret, SecretKind, SecretRef
from tests.meshctl.inventory.inventories import HEAD, load_text

_VALUE = "correct horse battery staple"


def _ref(kind: SecretKind, where: str, key: str = "", identity: str = "") -> SecretRef:
    return SecretRef(kind, where, key, identity)


def test_a_secret_comes_from_the_environment(tmp_path: Path) -> None:
    store = SecretStore({"MESH_KEY": _VALUE}, tmp_path)
    assert store.get(_ref(SecretKind.ENV, "MESH_KEY")).reveal() == _VALUE


@pytest.mark.parametrize(("environ", "reason"), [({}, "is not set"), ({"MESH_KEY": ""}, "is empty")])
def test_an_empty_variable_is_not_called_unset(environ: dict[str, str], reason: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"the environment variable {reason}"):
        SecretStore(environ, tmp_path).get(_ref(SecretKind.ENV, "MESH_KEY"))


def test_a_secret_is_a_whole_file_or_one_entry_of_it(tmp_path: Path) -> None:
    (tmp_path / "whole").write_text(f"{_VALUE}\n")
    (tmp_path / "many.yaml").write_text(f'mesh: "{_VALUE}"\nother: 0123\n')
    store = SecretStore({}, tmp_path)
    assert store.get(_ref(SecretKind.FILE, "whole")).reveal() == _VALUE
    assert store.get(_ref(SecretKind.FILE, "many.yaml", "mesh")).reveal() == _VALUE
    assert store.get(_ref(SecretKind.FILE, "many.yaml", "other")).reveal() == "0123"


def test_an_age_file_opens_with_its_identity(tmp_path: Path) -> None:
    identity = pyrage.x25519.Identity.generate()
    (tmp_path / "id.txt").write_text(f"# created today\n# public key: {identity.to_public()}\n{identity}\n")
    (tmp_path / "s.age").write_bytes(pyrage.encrypt(f"mesh: {_VALUE}\n".encode(), [identity.to_public()]))
    by_name = SecretStore({}, tmp_path)
    assert by_name.get(_ref(SecretKind.AGE, "s.age", "mesh", "id.txt")).reveal() == _VALUE
    by_environment = SecretStore({"MESHCTL_AGE_IDENTITY": str(tmp_path / "id.txt")}, tmp_path)
    assert by_environment.get(_ref(SecretKind.AGE, "s.age", "mesh")).reveal() == _VALUE


def test_a_file_is_read_once(tmp_path: Path) -> None:
    path = tmp_path / "many.yaml"
    path.write_text("a: one\nb: two\n")
    store = SecretStore({}, tmp_path)
    assert store.get(_ref(SecretKind.FILE, "many.yaml", "a")).reveal() == "one"
    path.unlink()
    assert store.get(_ref(SecretKind.FILE, "many.yaml", "b")).reveal() == "two"


def test_paths_are_relative_to_the_file_that_names_them_or_to_home(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "k").write_text("below")
    (tmp_path / "k").write_text("home")
    store = SecretStore({"HOME": str(tmp_path)}, Path("/nowhere"))
    assert store.get(SecretRef(SecretKind.FILE, "k", base=str(tmp_path / "sub"))).reveal() == "below"
    assert store.get(SecretRef(SecretKind.FILE, "~/k")).reveal() == "home"


def _broken(directory: Path) -> dict[str, SecretRef]:
    """References that fail, most of them next to the secret itself."""
    identity, stranger = pyrage.x25519.Identity.generate(), pyrage.x25519.Identity.generate()
    (directory / "id.txt").write_text(f"{stranger}\n")
    (directory / "bad-id.txt").write_text(f"{_VALUE}\n")
    (directory / "no-id.txt").write_text("# nothing\n")
    (directory / "s.age").write_bytes(pyrage.encrypt(_VALUE.encode(), [identity.to_public()]))
    (directory / "plain.age").write_text(_VALUE)
    (directory / "list.yaml").write_text(f"- {_VALUE}\n")
    (directory / "syntax.yaml").write_text(f'mesh: "{_VALUE}" !{_VALUE.replace(" ", "")} [\n')
    (directory / "deep.yaml").write_text(f"mesh: {{a: {_VALUE}}}\n")
    (directory / "latin.yaml").write_bytes(b"mesh: \xff\n")
    (directory / "empty").write_text("\n")
    (directory / "huge").write_bytes(b"x" * 2_000_000)
    return {
        "not set": _ref(SecretKind.ENV, "NOT_SET"),
        "no file": _ref(SecretKind.FILE, "gone"),
        "NUL": _ref(SecretKind.FILE, "a\0b"),
        "a directory": _ref(SecretKind.FILE, "."),
        "no entry": _ref(SecretKind.FILE, "deep.yaml", "mash"),
        "no text": _ref(SecretKind.FILE, "deep.yaml", "mesh"),
        "a list": _ref(SecretKind.FILE, "list.yaml", "mesh"),
        "not YAML": _ref(SecretKind.FILE, "syntax.yaml", "mesh"),
        "not text": _ref(SecretKind.FILE, "latin.yaml", "mesh"),
        "empty": _ref(SecretKind.FILE, "empty"),
        "too large": _ref(SecretKind.FILE, "huge"),
        "no identity": _ref(SecretKind.AGE, "s.age"),
        "wrong identity": _ref(SecretKind.AGE, "s.age", "", "id.txt"),
        "bad identity": _ref(SecretKind.AGE, "s.age", "", "bad-id.txt"),
        "empty identity": _ref(SecretKind.AGE, "s.age", "", "no-id.txt"),
        "not encrypted": _ref(SecretKind.AGE, "plain.age", "", "id.txt"),
        "no home": _ref(SecretKind.FILE, "~/k"),
    }


def test_an_unavailable_secret_is_a_located_error_that_does_not_reveal_it(tmp_path: Path) -> None:
    store = SecretStore({}, tmp_path)
    for name, ref in _broken(tmp_path).items():
        with pytest.raises(InputError) as caught:
            store.get(ref, Position("fleet.yaml", 7, 3))
        text = "".join(traceback.format_exception(caught.value)) + caught.value.hint
        assert "fleet.yaml:7:3" in text, name
        assert not any(word in text for word in ("correct", "battery", "correcthorse")), name


def test_secrets_and_stores_are_never_shown_as_text_or_serialized(tmp_path: Path) -> None:
    store = SecretStore({"K": _VALUE}, tmp_path)
    secret = store.get(_ref(SecretKind.ENV, "K"))
    shown = [repr(secret), str(secret), f"{secret}", f"{secret:>40}", f"{secret!r}", repr([secret]), repr(store)]
    assert not any(_VALUE in text for text in shown)
    assert secret == Secret(_VALUE)
    with pytest.raises(TypeError):
        pickle.dumps(secret)
    with pytest.raises(TypeError):
        json.dumps(secret)


@pytest.mark.parametrize(
    "text",
    [
        "udp_mesh: {keys: [hunter2!]}\n",
        "udp_mesh: {keys: hunter2!}\n",
        "udp_mesh: {keys: [[hunter2!]]}\n",
        "udp_mesh: {keys: [{env: hunter2!}]}\n",
        "udp_mesh: {keys: [{hunter: hunter2!}]}\n",
        "udp_mesh: {key: hunter2!}\n",
        "meshes: {m: {key: hunter2!}}\n",
        "meshes: {m: {psk: hunter2!, password: hunter2!}}\n",
        "meshes: {m: hunter2!}\n",
        "meshes: [hunter2!]\n",
        "operators: {password: hunter2!}\n",
    ],
)
def test_an_inline_secret_in_the_inventory_is_rejected_and_not_echoed(text: str, tmp_path: Path) -> None:
    loaded = load_text(tmp_path, HEAD.replace("meshes:\n", "x:\n") + text)
    assert loaded.fleet is None
    assert not any("hunter2!" in repr(item) for item in loaded.diagnostics)


def test_loader_errors_never_show_environment_values(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text(HEAD + "udp_mesh: {keys: [{env: K, key: x}]}\n")
    loaded = load(tmp_path, environ={"K": _VALUE})
    assert loaded.diagnostics
    assert _VALUE not in repr(loaded)
