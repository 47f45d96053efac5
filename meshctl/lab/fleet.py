"""The Python face of a virtual fleet: start it, reach into its nodes, hurt it, end it.

`VirtualFleet(spec, directory).up()` starts the fleet's supervisor as a process of its own and waits until every node
has booted; everything else is one request over the supervisor's socket. `VirtualFleet.attach(directory)` finds a
fleet that another process started.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, Self

from meshctl.device.connection import Completed, Endpoint
from meshctl.lab.spec import FleetSpec


class VirtualNode:
    """One node of a running fleet, seen from outside: its power switch, its console, its flash."""

    name: str

    @property
    def address(self) -> str | None:
        """Its LAN's IPv4 address at this moment (`10.42.0.11`); None while it is off or has none."""
        raise NotImplementedError

    @property
    def boot_id(self) -> str | None:
        """Changes with every boot; None while it is off."""
        raise NotImplementedError

    @property
    def flash_path(self) -> Path:
        """The directory that is its flash, what survives a power cut: `flash_path / "etc/config/network"`."""
        raise NotImplementedError

    @property
    def bench(self) -> Endpoint:
        """Its LAN port on the bench: answers while the node is plugged in there and has the address 192.168.1.1."""
        raise NotImplementedError

    def exec(self, command: str, *, stdin: bytes = b"", timeout_s: float = 60.0) -> Completed:
        """Run a shell command on its serial console, which works without network or SSH server."""
        raise NotImplementedError

    def reboot(self, *, wait_s: float = 60.0) -> None:
        """An orderly reboot (`reboot` on the node); returns when it is up again."""
        raise NotImplementedError

    def power_cut(self, *, unsynced: str = "lost", back: bool = True, wait_s: float = 60.0) -> None:
        """Take its power away at once. What was written and not synced is `lost`, `kept`, or `torn` (files there but
        empty); `back` gives power again and waits until it is up (or stays down, being bricked)."""
        raise NotImplementedError

    def power_on(self, *, wait_s: float = 60.0) -> None: ...

    def is_up(self) -> bool:
        raise NotImplementedError

    def record_steps(self) -> None:
        """From now on write down each external command it runs, for `steps()`."""

    def steps(self) -> tuple[str, ...]:
        """The external commands since `record_steps()`, in order; the n-th (from 1) is what `power-cut@n` strikes."""
        raise NotImplementedError


class VirtualFleet:
    """A fleet in `directory` (made if needed). Use as a context manager, or call `up()` and `down()`."""

    def __init__(self, spec: FleetSpec, directory: Path) -> None:
        self.spec = spec
        self.directory = directory

    @classmethod
    def attach(cls, directory: Path) -> Self:
        """The fleet that runs in `directory`; raises LabError when none does."""
        raise NotImplementedError

    def up(self, *, wait_s: float = 120.0) -> Self:
        """Start it and wait until every node has booted. Raises LabError with the reason and the log's path."""
        raise NotImplementedError

    def down(self) -> None:
        """End it: every process, mount and namespace is gone when this returns. `directory` stays, for a look."""
        raise NotImplementedError

    def node(self, name: str) -> VirtualNode:
        raise NotImplementedError

    @property
    def port(self) -> int:
        """The TCP port that all its loopback addresses listen on."""
        raise NotImplementedError

    def endpoint(self, address: str, *, identity: str = "") -> Endpoint:
        """Where on this machine a node's address is reached: 10.42.0.11 -> 127.42.0.11, port `port`.

        It refuses connections unless a node holds that address and a path from the base to it exists at that moment.
        """
        raise NotImplementedError

    def break_(self, where: str, what: str) -> None:
        """`where` is a node or a link (`b01-b02`), `what` one of `breaks.BREAKS` (`power-cut@7`, `full-flash`, ...)."""
        raise NotImplementedError

    def mend(self, where: str = "") -> None:
        """Undo every break (of one node or link): links up, power on, flash freed, bricked nodes recovered."""
        raise NotImplementedError

    def link(self, a: str, b: str, **changes: Any) -> None:
        """Change a link's fields (`up`, `delay_ms`, `loss`, `rate_kbps`, `tq`), or make one that was not there."""
        raise NotImplementedError

    def status(self) -> dict[str, Any]:
        """What `meshctl lab status --json` prints."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self.up()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.down()
