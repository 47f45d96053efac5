"""Opens and closes sockets to match the attachments that exist: interfaces come and go while the node runs.

`refresh` -> dump the kernel's interfaces -> select attachments -> close sockets of those gone, open new ones, reopen
changed ones. A socket that cannot be opened is reported and retried at the next refresh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from udp_mesh.links.attachments import MIN_MTU, Attachment, LinkConfig, select_attachments
from udp_mesh.links.netlink import interfaces
from udp_mesh.links.udp import UdpLink


@dataclass(frozen=True, slots=True)
class LinkChanges:
    """The result of a refresh. A reopened link is in `gone` and in `opened`."""

    opened: tuple[UdpLink, ...] = ()
    gone: tuple[UdpLink, ...] = ()
    """Already closed; `attachment` says what they were."""
    failed: dict[str, str] = field(default_factory=dict)
    """Link name -> reason why its socket could not be opened."""


class LinkHub:
    """The open links by name."""

    def __init__(self, configs: Sequence[LinkConfig], port: int, *, urgent_dscp: int = 0) -> None:
        self.configs = tuple(configs)
        self.links: dict[str, UdpLink] = {}
        self._port = port
        self._urgent_dscp = urgent_dscp

    def refresh(self) -> LinkChanges:
        """Opens and closes sockets to match the kernel's interfaces. Raises NetlinkError if they cannot be listed."""
        wanted = {
            attachment.name: attachment for attachment in select_attachments(interfaces(), self.configs, self._port)
        }
        gone = [link for name, link in self.links.items() if wanted.get(name) != link.attachment]
        for link in gone:
            link.close()
            del self.links[link.attachment.name]
        opened: list[UdpLink] = []
        failed: dict[str, str] = {}
        for name, attachment in wanted.items():
            if name not in self.links:
                outcome = self._open(attachment)
                if isinstance(outcome, UdpLink):
                    self.links[name] = outcome
                    opened.append(outcome)
                else:
                    failed[name] = outcome
        return LinkChanges(tuple(opened), tuple(gone), failed)

    def _open(self, attachment: Attachment) -> UdpLink | str:
        if attachment.mtu < MIN_MTU:
            return f"expected an MTU of at least {MIN_MTU} bytes, found {attachment.mtu} on {attachment.device}"
        try:
            return UdpLink(attachment, urgent_dscp=self._urgent_dscp)
        except OSError as error:
            host, port = attachment.address
            return f"{error.strerror or error} (UDP port {port} at {host} on {attachment.device})"

    def close(self) -> None:
        for link in self.links.values():
            link.close()
        self.links.clear()
