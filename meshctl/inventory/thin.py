"""Thin links: documents -> model."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from meshctl.inventory.documents.thin import ThinLinkDocument, ThinPortsDocument
from meshctl.model import ThinLink, ThinPorts


def thin_links(documents: Mapping[str, ThinLinkDocument]) -> Mapping[str, ThinLink]:
    """The fleet's thin links by name."""
    return MappingProxyType({name: _link(document) for name, document in documents.items()})


def _link(document: ThinLinkDocument) -> ThinLink:
    return ThinLink(
        document.bits_per_s,
        document.band,
        document.baud,
        document.framing.frame_bytes if document.frame_bytes is None else document.frame_bytes,
        document.frame_s,
        document.duty_cycle,
        document.framing,
    )


def thin_ports(document: ThinPortsDocument | None) -> ThinPorts | None:
    """A robot's number and ports (None: it has none)."""
    return None if document is None else ThinPorts(document.number, MappingProxyType(dict(document.ports)))
