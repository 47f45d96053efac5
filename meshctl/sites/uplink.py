"""The operator's side of a site's worker: requests, whatever carries them (`ssh_uplink`, `nats_uplink`)."""

from __future__ import annotations

import base64
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from meshctl import __version__
from meshctl.errors import InputError, Unreachable
from meshctl.model import Site
from meshctl.sites.order import SignedOrder
from meshctl.sites.protocol import PROTOCOL


@dataclass(frozen=True, slots=True)
class RemoteRun:
    """A run as its worker lists it; `state` as in `runs.RunState`."""

    run: str
    state: str
    operator: str
    command: str
    began_s: float


@dataclass(frozen=True, slots=True)
class Greeting:
    """A worker's greeting: its version, the fingerprints of the keys that may sign, its runs."""

    version: str
    directory: str
    operators: tuple[str, ...]
    runs: tuple[RemoteRun, ...]

    def run(self, run: str) -> RemoteRun | None:
        return next((each for each in self.runs if each.run == run), None)


@dataclass(frozen=True, slots=True)
class Parcel:
    """Everything a site needs to execute an order: the order, and the data that it names by hash. A worker that has
    planned the run has the rest already."""

    order: SignedOrder
    run: str
    part: bytes = field(default=b"", repr=False)
    plan: str = field(default="", repr=False)
    images: Mapping[str, str] = field(default_factory=dict)


class SiteOffline(Unreachable):
    """The worker of a site cannot be asked now."""


class Uplink(ABC):
    """The connection to the worker of one site. Not shared between threads; `close` may come from any."""

    site: Site

    @property
    @abstractmethod
    def greeting(self) -> Greeting:
        """The worker's greeting. Raises Unreachable if none has arrived."""

    @abstractmethod
    def ask(self, request: Mapping[str, object]) -> dict[str, Any]:
        """Send a request and wait for its reply for as long as the worker is alive. Raises WorkerError."""

    @property
    @abstractmethod
    def accepted_keys(self) -> tuple[str, ...]:
        """The fingerprints of the keys whose orders the worker accepts."""

    @property
    def has_contact(self) -> bool:
        """Whether the worker itself has answered since this uplink was made."""
        return True

    @abstractmethod
    def send_images(self, images: Mapping[str, Path]) -> None:
        """Upload the images (by SHA-256) that the gateway lacks."""

    @abstractmethod
    def start(self, parcel: Parcel) -> None:
        """Order a run, once, however often this is repeated."""

    @abstractmethod
    def follow(self, run: str, offset: int) -> Iterator[dict[str, Any]]:
        """Replies with events of a run, from `offset` on; the last one has `over`."""

    @abstractmethod
    def stop(self, run: str) -> bool:
        """Ask a run to stop, also while another thread follows it; whether it is in progress."""

    @abstractmethod
    def close(self) -> None:
        """End the uplink, and let the worker delete what it planned and was not ordered."""

    def state_of(self, run: str) -> str:
        """The state of a run as in `runs.RunState`, `waiting` for an order that has not reached its site, or empty for
        a run that is not known."""
        there = self.greeting.run(run)
        return "" if there is None else there.state

    def install(self, operators: Sequence[str]) -> str:
        """Let these public keys sign orders; returns the worker's own public key, which it makes if it has none."""
        return str(self.ask({"do": "install", "operators": list(operators)})["public_key"])

    def plan(
        self,
        run: str,
        part: bytes,
        images: Mapping[str, str],
        nodes: Sequence[str],
        options: Sequence[str],
        agreed: str = "",
    ) -> tuple[str, dict[str, Any]]:
        """The plan that the worker made, or what still applies of the saved plan `agreed`, as JSON; and node -> what it
        would replace there. `images` are paths in the part with the SHA-256 of their content."""
        reply = self.ask(
            {
                "do": "plan",
                "run": run,
                "part": base64.b64encode(part).decode(),
                "images": dict(images),
                "nodes": list(nodes),
                "options": list(options),
                "agreed": agreed,
            }
        )
        return str(reply["plan"]), dict(reply["replaced"])

    def status(self, run: str, part: bytes, nodes: Sequence[str], options: Sequence[str]) -> str:
        """The status of the site's nodes, as `meshctl status --json` prints it there."""
        encoded = base64.b64encode(part).decode()
        request = {"do": "status", "run": run, "part": encoded, "nodes": list(nodes), "options": list(options)}
        return str(self.ask(request)["status"])

    def has_forgotten(self, run: str) -> bool:
        """Whether the site started a run and has deleted what it knew of it."""
        return bool(self.ask({"do": "forgotten", "run": run})["forgotten"])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def greeting_of(reply: Mapping[str, Any], site: str) -> Greeting:
    """The answer to `hello`. Raises InputError for a worker of another version."""
    if reply.get("protocol") != PROTOCOL or reply.get("meshctl") != __version__:
        raise InputError(
            f"site {site}: its worker runs meshctl {reply.get('meshctl')}, this computer {__version__}",
            hint=f"run `meshctl sites install {site}`",
        )
    runs = (
        RemoteRun(
            str(each["run"]), str(each["state"]), str(each["operator"]), str(each["command"]), float(each["began_s"])
        )
        for each in reply["runs"]
    )
    return Greeting(str(reply["meshctl"]), str(reply["directory"]), tuple(map(str, reply["operators"])), tuple(runs))
