"""Keys of a thin link that belong to its framing, and airtime from a preset of Meshtastic."""

from __future__ import annotations

import pytest

from meshctl.inventory.documents.thin import ThinLinkDocument
from meshctl.inventory.thin import thin_links
from meshctl.inventory.tree import Plain
from meshctl.model import ThinFraming, ThinLink, ThinPreset


def document(**keys: str) -> ThinLinkDocument:
    """As YAML gives the values."""
    return ThinLinkDocument.model_validate({key: Plain(value) for key, value in keys.items()})


def link(**keys: str) -> ThinLink:
    return thin_links({"one": document(**keys)})["one"]


def test_a_preset_gives_rate_and_fixed_time() -> None:
    found = link(framing="meshtastic", preset="SHORT_SLOW", hop_limit="2")
    assert (found.framing, found.preset, found.hop_limit) == (ThinFraming.MESHTASTIC, ThinPreset.SHORT_SLOW, 2)
    assert (found.bits_per_s, found.frame_s) == (ThinPreset.SHORT_SLOW.bits_per_s, ThinPreset.SHORT_SLOW.frame_s)
    assert found.frame_bytes == 200


def test_each_preset_can_be_chosen_and_long_fast_is_usual() -> None:
    for preset in ThinPreset:
        assert link(framing="meshtastic", preset=preset.name).preset is preset
    assert link(framing="meshtastic").preset is ThinPreset.LONG_FAST


def test_an_xbee_has_frames_that_every_xbee_takes() -> None:
    found = link(framing="xbee", bits_per_s="10000")
    assert (found.frame_bytes, found.preset) == (72, None)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({}, "bits_per_s, the rate on the air"),
        ({"framing": "xbee"}, "bits_per_s, the rate on the air"),
        ({"framing": "meshtastic", "bits_per_s": "1000"}, "no bits_per_s, frame_s and baud"),
        ({"framing": "meshtastic", "baud": "9600"}, "no bits_per_s, frame_s and baud"),
        ({"framing": "meshtastic", "frame_bytes": "234"}, "frame_bytes of at most 233"),
        ({"bits_per_s": "1000", "preset": "LONG_FAST"}, "no preset and hop_limit"),
        ({"bits_per_s": "1000", "hop_limit": "1"}, "no preset and hop_limit"),
        ({"framing": "meshtastic", "preset": "FAST"}, "preset"),
        ({"framing": "meshtastic", "hop_limit": "4"}, "hop_limit"),
    ],
)
def test_keys_that_do_not_belong_to_the_framing_are_refused(keys: dict[str, str], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        document(**keys)
