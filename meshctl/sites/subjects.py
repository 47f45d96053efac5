"""The names of a site's subjects and streams in NATS, and the limits of streams. Pure.

meshctl.FLEET.SITE.ask          requests of operators who wait for the answer: not stored
meshctl.FLEET.SITE.beat         the worker is online: every few seconds, not stored
meshctl.FLEET.SITE.orders.RUN   orders, in the work queue `meshctl+FLEET+SITE+orders` of the hub
meshctl.FLEET.SITE.runs.RUN     events of runs, in the stream `meshctl+FLEET+SITE+runs` of the site's leaf node, which
                                the hub mirrors
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

# The consumer of a site's orders, which its worker makes.
CONSUMER = "worker"


@dataclass(frozen=True, slots=True)
class SiteSubjects:
    fleet: str
    site: str

    @property
    def _prefix(self) -> str:
        # a dot separates tokens, and no name has a tilde
        return ".".join(("meshctl", *(name.replace(".", "~") for name in (self.fleet, self.site))))

    @property
    def ask(self) -> str:
        return f"{self._prefix}.ask"

    @property
    def beat(self) -> str:
        return f"{self._prefix}.beat"

    def order(self, run: str) -> str:
        return f"{self._prefix}.orders.{run}"

    @property
    def orders(self) -> str:
        return self.order("*")

    def run(self, run: str) -> str:
        return f"{self._prefix}.runs.{run}"

    @property
    def runs(self) -> str:
        return self.run("*")

    @property
    def order_stream(self) -> str:
        return self._stream("orders")

    @property
    def run_stream(self) -> str:
        return self._stream("runs")

    def _stream(self, kind: str) -> str:
        return "+".join((*self._prefix.split("."), kind))


def stream_settings(days: int, max_bytes: int) -> dict[str, Any]:
    """The limits of a stream."""
    return {"max_age": days * 86_400, "max_bytes": max_bytes, "duplicate_window": 3600}
