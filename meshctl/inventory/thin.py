"""Thin links: documents -> model."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from meshctl.inventory.documents.thin import ThinLinkDocument, ThinPortsDocument
from meshctl.model import ThinFraming, ThinLink, ThinPorts, ThinPreset


def thin_links(documents: Mapping[str, ThinLinkDocument]) -> Mapping[str, ThinLink]:
    """The fleet's thin links by name."""
    return MappingProxyType({name: _link(document) for name, document in documents.items()})


def _link(document: ThinLinkDocument) -> ThinLink:
    preset, bits_per_s, frame_s = None, document.bits_per_s, document.frame_s
    if document.framing is ThinFraming.MESHTASTIC:
        preset = ThinPreset[document.preset]
        bits_per_s, frame_s = preset.bits_per_s, preset.frame_s
    return ThinLink(
        bits_per_s,
        document.band,
        document.baud,
        document.framing.frame_bytes if document.frame_bytes is None else document.frame_bytes,
        frame_s,
        document.duty_cycle,
        document.framing,
        preset,
        document.hop_limit,
    )


def thin_ports(document: ThinPortsDocument | None) -> ThinPorts | None:
    """A robot's number and ports (None: it has none)."""
    return None if document is None else ThinPorts(document.number, MappingProxyType(dict(document.ports)))
