"""The events of a change on one node, for a listener that acts on the node's neighbors (`station_flush`)."""

from __future__ import annotations

from collections.abc import Container, Iterable
from contextlib import AbstractContextManager
from typing import Protocol

from meshctl.device.observation import Observation
from meshctl.device.ssh import SshConnection


class ChangeListener(Protocol):
    """Receives the events of one node's change. No event alters the outcome of the change.

    `armed` comes first, in a simultaneous change after `restarting`; if a whole mesh changes its
    cell, `watch_own_entries` comes instead. Then `started`, again for each new attempt; `waiting`,
    `connecting`, `unreachable` and `observed` while the node is polled; `ended` once its end was observed.
    A power cut may come first: then `connecting` and `unreachable` precede `armed`.
    """

    def restarting(self, names: Iterable[str]) -> None:
        """The radios of these nodes restart at the same moment: they keep no station entry from before."""

    def armed(self, connection: SshConnection | None, *, for_s: float, is_alone: bool = True) -> None:
        """The change starts next and ends within `for_s`; the node still forwards its neighbors' frames.

        `connection` is None for a node that loses its processes in the change. `is_alone`: no other node's radio
        restarts in the same change. Raises Unreachable.
        """

    def watch_own_entries(self, connection: SshConnection, *, for_s: float, is_alone: bool = False) -> None:
        """The node's neighbors change at the same moment, and all changes end within `for_s`. Raises Unreachable."""

    def started(self) -> None:
        """The change starts: from now on the node's radios may restart."""

    def connecting(self) -> AbstractContextManager[None]:
        """Wraps an attempt to connect to the node."""

    def waiting(self, connection: SshConnection) -> AbstractContextManager[None]:
        """Wraps a wait for the node's answer over a connection that the change may cut."""

    def unreachable(self, among: Container[str] | None = None, *, is_login_due: bool = False) -> None:
        """The node did not answer. `among`: the only nodes that are reachable now. `is_login_due`: from now on its SSH
        server has to answer a login, if only by a refusal."""

    def observed(self) -> None:
        """The node answered, and the change is still applied."""

    def ended(self, now: Observation | None = None, *, went_back: bool = False, rebooted: bool = False) -> None:
        """The change was confirmed, or rolled back (`went_back`). `now` is the latest observation."""
