"""API frames of XBee radios: Digi's own library reads what is written and writes what is read; damage is skipped."""

from __future__ import annotations

import json

import pytest
from digi.xbee.models.address import XBee16BitAddress, XBee64BitAddress
from digi.xbee.models.mode import OperatingMode
from digi.xbee.models.status import ModemStatus, TransmitStatus
from digi.xbee.packets.base import XBeePacket
from digi.xbee.packets.common import ModemStatusPacket, ReceivePacket, TransmitPacket, TransmitStatusPacket
from digi.xbee.packets.factory import build_frame
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.wire.make_vectors import FOLDER
from udp_mesh.wire.limits import MAX_THIN_FRAME_BYTES
from udp_mesh.wire.xbee import USUAL_FRAME_BYTES, XBeeDecoder, encode_transmit_request

MODES = [pytest.param(False, id="AP=1"), pytest.param(True, id="AP=2")]
FRAME = st.binary(min_size=1, max_size=MAX_THIN_FRAME_BYTES)
MOST_ON_LINE = 3 + 18 + 256
"""Of an API frame without escapes."""
SOURCE = XBee64BitAddress.from_hex_string("0013A20040A1B2C3")


def mode(escaped: bool) -> OperatingMode:
    return OperatingMode.ESCAPED_API_MODE if escaped else OperatingMode.API_MODE


def parsed(line: bytes, *, escaped: bool) -> TransmitPacket:
    """As Digi's library reads it from a port."""
    raw = bytearray(line)
    packet = build_frame(XBeePacket.unescape_data(raw) if escaped else raw, mode(escaped))
    assert isinstance(packet, TransmitPacket)
    return packet


def received(frame: bytes, *, escaped: bool) -> bytes:
    """What a radio writes for a frame that it received, as Digi's library builds it."""
    packet = ReceivePacket(SOURCE, XBee16BitAddress.UNKNOWN_ADDRESS, 0x02, bytearray(frame), op_mode=mode(escaped))
    return bytes(packet.output(escaped=escaped))


def status(code: TransmitStatus, *, escaped: bool) -> bytes:
    packet = TransmitStatusPacket(1, XBee16BitAddress.UNKNOWN_ADDRESS, 0, transmit_status=code, op_mode=mode(escaped))
    return bytes(packet.output(escaped=escaped))


@given(FRAME, st.booleans())
def test_digis_library_reads_what_is_written(frame: bytes, escaped: bool) -> None:
    line = encode_transmit_request(frame, escaped=escaped)
    packet = parsed(line, escaped=escaped)
    assert bytes(packet.rf_data) == frame
    assert packet.x64bit_dest_addr == XBee64BitAddress.BROADCAST_ADDRESS
    assert packet.x16bit_dest_addr == XBee16BitAddress.UNKNOWN_ADDRESS
    assert (packet.broadcast_radius, packet.transmit_options) == (0, 0)
    assert packet.frame_id != 0
    assert bytes(packet.output(escaped=escaped)) == line
    if escaped:
        assert not {0x7E, 0x11, 0x13} & set(line[1:])


@given(st.lists(FRAME, max_size=5), st.lists(st.integers(1, 300), max_size=30), st.booleans())
def test_what_digis_library_writes_arrives_however_the_line_is_cut(
    frames: list[bytes], cuts: list[int], escaped: bool
) -> None:
    line = b"".join(received(frame, escaped=escaped) for frame in frames)
    decoder, found, at = XBeeDecoder(escaped=escaped), [], 0
    for cut in [*cuts, len(line)]:
        found += decoder.feed(line[at : at + cut])
        at += cut
    assert found == frames
    assert decoder.damaged == 0


@given(st.binary(max_size=700), st.lists(FRAME, max_size=3), st.booleans())
def test_after_noise_frames_arrive_again(noise: bytes, frames: list[bytes], escaped: bool) -> None:
    """At once with escapes; without them when the length that the noise seemed to state has passed."""
    decoder = XBeeDecoder(escaped=escaped)
    decoder.feed(noise if escaped else noise + bytes(MOST_ON_LINE))
    before = decoder.damaged
    assert decoder.feed(b"".join(received(frame, escaped=escaped) for frame in frames)) == frames
    assert decoder.damaged <= before + 1


@given(FRAME, st.booleans(), st.data())
def test_a_changed_byte_of_the_content_is_noticed(frame: bytes, escaped: bool, data: st.DataObject) -> None:
    packet = bytearray(received(frame, escaped=False))
    place = data.draw(st.integers(3, len(packet) - 1))
    packet[place] ^= data.draw(st.integers(1, 255))
    line = bytes(packet)
    if escaped:
        line = line[:1] + bytes(ReceivePacket._escape_data(packet[1:]))
    decoder = XBeeDecoder(escaped=escaped)
    found = decoder.feed(line + bytes(MOST_ON_LINE))
    assert frame not in found
    assert decoder.damaged >= 1


@pytest.mark.parametrize("escaped", MODES)
def test_a_refusal_is_known_until_the_radio_sends_again(escaped: bool) -> None:
    decoder = XBeeDecoder(escaped=escaped)

    def after(code: TransmitStatus) -> str | None:
        assert decoder.feed(status(code, escaped=escaped)) == []
        return decoder.refusal

    assert after(TransmitStatus.SUCCESS) is None
    assert after(TransmitStatus.CCA_FAILURE) == "the channel is busy"
    assert after(TransmitStatus.SUCCESS) is None
    assert after(TransmitStatus.KEY_NOT_AUTHORIZED) == "its delivery status is 0xbb"
    refusal = after(TransmitStatus.PAYLOAD_TOO_LARGE)
    assert refusal is not None
    assert "too large" in refusal
    assert after(TransmitStatus.SUCCESS) == after(TransmitStatus.CCA_FAILURE) == refusal
    assert decoder.damaged == 0


@pytest.mark.parametrize("escaped", MODES)
def test_what_is_about_the_radio_itself_is_no_frame(escaped: bool) -> None:
    decoder = XBeeDecoder(escaped=escaped)
    packet = ModemStatusPacket(ModemStatus.HARDWARE_RESET, op_mode=mode(escaped))
    line = bytes(packet.output(escaped=escaped))
    assert decoder.feed(line + received(b"one", escaped=escaped)) == [b"one"]
    assert decoder.damaged == 0


def api(content: bytes) -> bytes:
    return b"\x7e" + len(content).to_bytes(2, "big") + content + bytes((0xFF - (sum(content) & 0xFF),))


@pytest.mark.parametrize("escaped", MODES)
@pytest.mark.parametrize(
    "line",
    [
        pytest.param(b"\x7e\0\0\xff", id="no content"),
        pytest.param(b"\x7e\xff\xff" + b"\1" * 100, id="a length beyond all radios"),
        pytest.param(api(b"\x90"), id="a packet without addresses"),
        pytest.param(api(b"\x90" + bytes(11)), id="a packet without a frame"),
        pytest.param(api(b"\x90" + bytes(11) + b"\1" * 256), id="a frame beyond the largest"),
        pytest.param(b"\x7e" * 1000, id="starts alone"),
    ],
)
def test_what_no_radio_of_this_link_sends_is_counted(line: bytes, escaped: bool) -> None:
    decoder = XBeeDecoder(escaped=escaped)
    assert decoder.feed(line) == []
    assert decoder.feed(received(b"next", escaped=escaped) + bytes(MOST_ON_LINE)) == [b"next"]
    assert decoder.damaged >= 1


@pytest.mark.parametrize("escaped", MODES)
@pytest.mark.parametrize("noise", [b"\x55", b"\x7e", b"\x7d", b"\x7e\x01\x00", b"\x7e\x01\x00\x7d", b"\x7e\0\x0d\x90"])
def test_an_endless_line_is_held_up_to_one_frame(noise: bytes, escaped: bool) -> None:
    decoder = XBeeDecoder(escaped=escaped)
    for _ in range(300):
        assert decoder.feed(noise * 50) == []
        assert len(decoder._unfinished) <= 2 * MOST_ON_LINE
    assert decoder.feed(bytes(2 * MOST_ON_LINE) + received(b"after", escaped=escaped))[-1:] == [b"after"]


def test_published_lines_are_those_of_digis_library() -> None:
    vectors = json.loads((FOLDER / "thin.json").read_text())
    for vector in vectors["frames"]:
        frame = bytes.fromhex(vector["frame"])
        for key, escaped in (("xbee", False), ("xbee_escaped", True)):
            request = parsed(bytes.fromhex(vector[key]["transmit_request"]), escaped=escaped)
            assert bytes(request.rf_data) == frame
            assert vector[key]["receive_packet"] == received(frame, escaped=escaped).hex()
            assert XBeeDecoder(escaped=escaped).feed(bytes.fromhex(vector[key]["receive_packet"])) == [frame]


def test_the_usual_frame_has_room_on_every_xbee() -> None:
    """NP of XBee 3 with DigiMesh, the smallest of those that Digi lists without encryption."""
    assert USUAL_FRAME_BYTES <= 73
