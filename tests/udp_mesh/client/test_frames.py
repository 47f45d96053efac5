"""The local API's frames: any pieces give the frames that were written, any bytes give frames or an error."""

import ast
import socket
import sys
from array import array
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import udp_mesh.client.mesh_client as mesh_client
from udp_mesh.client.mesh_client import Frame, FrameReader, MeshClient, MeshError, encode_frame

headers = st.dictionaries(st.text(max_size=5), st.one_of(st.integers(), st.text(max_size=5), st.booleans()), max_size=3)


def test_the_length_of_an_array_is_that_of_its_bytes() -> None:
    """The rest of an image was read as the next request."""
    samples: Any = array("d", [1.5, 2.5])
    rows: Any = memoryview(bytes(6)).cast("B", (2, 3))
    ((_, payload), (_, image)) = FrameReader().feed(encode_frame({}, samples) + encode_frame({}, rows))
    assert (bytes(payload), bytes(image)) == (samples.tobytes(), bytes(6))


@pytest.mark.parametrize("payload", ["text", None, 7, [1]])
def test_a_payload_that_is_no_buffer_is_named(payload: Any) -> None:
    with pytest.raises(TypeError, match="a bytes-like object is required, not "):
        encode_frame({}, payload)


@given(st.lists(st.tuples(headers, st.binary(max_size=50)), max_size=5), st.data())
def test_frames_are_reassembled_from_arbitrary_chunks(frames: list[Frame], data: st.DataObject) -> None:
    stream = b"".join(encode_frame(header, payload) for header, payload in frames)
    reader, found, place = FrameReader(), list[Frame](), 0
    while place < len(stream):
        end = data.draw(st.integers(place + 1, len(stream)))
        found += reader.feed(stream[place:end])
        place = end
    assert found == frames


@given(st.binary(max_size=60))
def test_any_bytes_decode_to_frames_or_raise_bad_frame(raw: bytes) -> None:
    try:
        FrameReader().feed(raw)
    except MeshError as error:
        assert error.code == "bad-frame"


@pytest.mark.parametrize(
    "raw",
    [
        b"\xff\xff\xff\xff\x00\x00\x00\x00",
        b"\x00\x00\x00\x02\xff\xff\xff\xff",
        b"\x00\x00\x00\x02\x00\x00\x00\x00[]",
        b"\x00\x00\x00\x02\x00\x00\x00\x00{x",
        b"\x00\x00\x00\x02\x00\x00\x00\x00\xff\xfe",
    ],
)
def test_an_invalid_frame_length_or_header_is_an_error(raw: bytes) -> None:
    with pytest.raises(MeshError):
        FrameReader().feed(raw)


def test_a_missing_daemon_error_names_the_socket(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"cannot connect to the daemon at .*mesh.sock: No such file") as caught:
        MeshClient(str(tmp_path / "mesh.sock"))
    assert caught.value.code == "unreachable"


def test_a_path_that_is_not_a_socket_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # a socket's path has at most 107 bytes
    monkeypatch.chdir(tmp_path)
    for path in (tmp_path, tmp_path / "file"):
        (tmp_path / "file").touch()
        with pytest.raises(MeshError, match=r"cannot connect to the daemon at .*: not a socket$"):
            MeshClient(str(path))
    with socket.socket(socket.AF_UNIX) as left_over:
        left_over.bind("s")
    with pytest.raises(MeshError, match=r"Connection refused$"):
        MeshClient("s")


@pytest.mark.parametrize("path", [Path(mesh_client.__file__), Path(mesh_client.__file__).parents[1] / "__init__.py"])
def test_the_client_uses_python_3_8_syntax_and_only_the_standard_library(path: Path) -> None:
    tree = ast.parse(path.read_text(), feature_version=(3, 8))
    imported = {
        name.split(".")[0]
        for node in tree.body
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
    }
    assert imported <= set(sys.stdlib_module_names)
