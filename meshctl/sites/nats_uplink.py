"""The uplink to a permanent worker over NATS: requests while its site is online, orders and events at any time.

A request goes through the hub to the worker, and nothing stores it: it makes sense only while the operator waits. An
order is stored at the hub until the site fetches it. Events are stored at the site's leaf node, and the hub copies
them. Neither server is trusted (`envelope`).
"""

from __future__ import annotations

import base64
import json
import queue
import secrets
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from meshctl.device.authentication import sign
from meshctl.device.connection import fingerprint_of
from meshctl.device.trust import HostKey, parse_key
from meshctl.errors import InputError, Unreachable
from meshctl.inventory.file_paths import file_path
from meshctl.model import Fleet, NatsHub, Site
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.site_gateways import gateway_credentials
from meshctl.sites.chunks import HEADER, Assembler, parse_chunk
from meshctl.sites.envelope import (
    EVENTS,
    REPLY,
    REQUEST,
    EnvelopeRefused,
    ReplyKey,
    opened_reply,
    sealed_for_worker,
    signed,
    verified,
)
from meshctl.sites.nats_client import NatsServer, shared
from meshctl.sites.nats_errors import NatsLost
from meshctl.sites.protocol import SILENCE_S, WorkerError, raise_error
from meshctl.sites.service import unit_name
from meshctl.sites.subjects import CONSUMER, SiteSubjects, stream_settings
from meshctl.sites.uplink import Greeting, Parcel, SiteOffline, Uplink, greeting_of

# How long the hub keeps orders and events, whatever their own limits are.
KEPT_DAYS = 90
# What it may store for a site. The server sets this much aside, and refuses streams beyond three quarters of its disk.
MAX_ORDERS_BYTES = 32 << 20
MAX_EVENTS_BYTES = 64 << 20
_SLICE_BYTES = 256 << 10
_POLL_S = 0.5
# After so long without events, a worker that is heard is asked for them.
_QUIET_S = 20.0
_NOT_STORED = "events do not come through the NATS servers, so the worker was asked: look at their disks and logs"


def hub_server(fleet: Fleet, hub: NatsHub) -> NatsServer:
    credentials = file_path(fleet, hub.credentials) if hub.credentials else None
    ca = file_path(fleet, hub.ca) if hub.ca else None
    return NatsServer(hub.url, credentials, ca, f"meshctl {fleet.name}")


class NatsUplink(Uplink):
    """Orders and events work without the worker; `greeting` and requests need it."""

    def __init__(self, fleet: Fleet, site: Site, access: ConnectionPool, *, must_answer: bool = True) -> None:
        """Raises InputError, NatsLost, and with `must_answer` what `greeting` raises."""
        self.site = site
        if site.nats is None:
            hint = f"orders for {site.name} are sent over SSH, while it is online"
            raise InputError(f"site {site.name} has no `nats`, so no order waits for it", hint=hint)
        if fleet.nats is None:
            raise InputError(f"site {site.name} has `nats`, and the inventory has no hub", hint="set `nats.url`")
        if not site.worker_key:
            raise InputError(f"site {site.name} has no worker_key", hint=f"run `meshctl sites install {site.name}`")
        self._worker: HostKey = parse_key(site.worker_key)
        self._nats, self._subjects = site.nats, SiteSubjects(fleet.name, site.name)
        self._fleet = fleet.name
        self._credentials = gateway_credentials(fleet, site, access.key_files, use_agent=access.use_agent)
        self._accepted = tuple(fingerprint_of(parse_key(line).blob) for line in fleet.operators.ssh_keys)
        self._client = shared(hub_server(fleet, fleet.nats))
        self._planned: list[str] = []
        self._is_closed = self._has_contact = False
        self._greeting: Greeting | None = None
        if must_answer:
            self._greet()

    def _greet(self) -> Greeting:
        if self._greeting is None:
            self._greeting = greeting_of(self.ask({"do": "hello"}), self.site.name)
        return self._greeting

    @property
    def greeting(self) -> Greeting:
        return self._greet()

    @property
    def has_contact(self) -> bool:
        return self._has_contact

    @property
    def accepted_keys(self) -> tuple[str, ...]:
        return self._accepted if self._greeting is None else self._greeting.operators

    def _sign(self, data: bytes) -> tuple[str, bytes]:
        found = sign(self._credentials, self.accepted_keys, data)
        if found is None:
            raise InputError(
                f"site {self.site.name}: no private key of operators.ssh_keys is available to sign a request",
                hint="pass --key, or start the SSH agent",
            )
        own, signature = found
        return f"{own.key_type} {own.base64}", signature

    def _request(self, nonce: str, key: ReplyKey, request: Mapping[str, object]) -> bytes:
        value = {
            "fleet": self._fleet,
            "site": self.site.name,
            "nonce": nonce,
            "reply_to": key.recipient,
            "request": dict(request),
        }
        return sealed_for_worker(signed(REQUEST, value, self._sign), self.site.worker_key)

    def ask(self, request: Mapping[str, object]) -> dict[str, Any]:
        key, nonce = ReplyKey.new(), secrets.token_hex(8)
        data = self._request(nonce, key, request)
        if request["do"] == "plan":
            self._planned.append(str(request["run"]))
        inbox, assembler, refused = self._client.new_inbox(), Assembler(), self._client.refusals.count
        with self._client.listening(inbox) as received:
            self._client.send_chunks(self._subjects.ask, nonce, data, inbox)
            heard_s = time.monotonic()
            while True:
                try:
                    message = received.get(timeout=_POLL_S)
                except queue.Empty:
                    self._client.refusals.check(refused, self._subjects.ask, inbox)
                    self._check_heard(heard_s)
                    continue
                headers = message.headers or {}
                if headers.get("Status") == "503":
                    raise self._offline("is not connected to the NATS hub")
                try:
                    whole = assembler.add(parse_chunk(headers.get(HEADER, ""), message.data))
                    if whole is None:
                        continue
                    value = verified(REPLY, opened_reply(whole, key), (self._worker,), "the worker")
                except (EnvelopeRefused, ValueError):
                    # not from the worker: anyone who may publish there can send it
                    continue
                if value.get("nonce") != nonce:
                    continue
                heard_s = time.monotonic()
                self._has_contact = True
                said = value.get("message")
                if isinstance(said, dict) and "beat" not in said:
                    raise_error(said, self.site.name)
                    return dict(said["reply"])

    def _check_heard(self, heard_s: float) -> None:
        if self._is_closed:
            raise NatsLost(f"site {self.site.name}: the uplink was closed")
        if not self._client.is_connected:
            raise NatsLost(f"site {self.site.name}: the connection to the NATS hub is lost")
        if time.monotonic() - heard_s > SILENCE_S:
            raise self._offline(f"does not answer over NATS: silent for {SILENCE_S:g} s")

    def _offline(self, text: str) -> SiteOffline:
        name = self.site.name
        unit = unit_name(self._fleet, name)
        hint = f"check the uplink of {name}, its leaf node, and `systemctl --user status {unit}` on its gateway"
        return SiteOffline(f"site {name} {text}", hint=hint)

    def send_images(self, images: Mapping[str, Path]) -> None:
        """An interrupted upload is resumed."""
        missing = self.ask({"do": "images", "sha256": list(images)})["missing"] if images else []
        for sha256 in missing:
            offset = int(self.ask({"do": "image", "sha256": sha256, "offset": 0, "data": ""})["size"])
            with images[sha256].open("rb") as file:
                file.seek(offset)
                while data := file.read(_SLICE_BYTES):
                    encoded = base64.b64encode(data).decode()
                    self.ask({"do": "image", "sha256": sha256, "offset": offset, "data": encoded})
                    offset += len(data)
            self.ask({"do": "image", "sha256": sha256, "offset": offset, "data": "", "is_last": True})

    def start(self, parcel: Parcel) -> None:
        subject, stream = self._subjects.order(parcel.run), self._subjects.order_stream
        limits = stream_settings(KEPT_DAYS, MAX_ORDERS_BYTES)
        # one order too many is refused: it replaces none that waits
        self._client.ensure_stream(
            name=stream, subjects=[self._subjects.orders], retention="workqueue", discard="new", **limits
        )
        self._client.restart_consumer(stream, CONSUMER)
        # not to be deleted when this uplink is closed: the order may be on its way
        self._planned = [run for run in self._planned if run != parcel.run]
        if self._client.queued(stream, subject):
            return
        order = parcel.order
        value = {
            "order": order.text,
            "key": order.key,
            "signature": order.signature,
            "part": base64.b64encode(parcel.part).decode(),
            "plan": parcel.plan,
            "images": dict(parcel.images),
        }
        data = sealed_for_worker(json.dumps(value).encode(), self.site.worker_key)
        # pieces of two attempts, which are sealed differently, do not fit together
        self._client.store(subject, f"{parcel.run}-{secrets.token_hex(4)}", data)

    def cancel(self, run: str) -> bool:
        """Delete an order that waits at the hub; whether there was one."""
        return self._client.purge(self._subjects.order_stream, self._subjects.order(run)) > 0

    def waiting(self) -> tuple[str, ...]:
        """The runs whose orders wait at the hub."""
        subjects = self._client.subjects(self._subjects.order_stream)
        return tuple(sorted(subject.rpartition(".")[2] for subject in subjects))

    def state_of(self, run: str) -> str:
        if self._client.queued(self._subjects.run_stream, self._subjects.run(run)):
            return "in progress"
        if self._client.queued(self._subjects.order_stream, self._subjects.order(run)):
            self._client.restart_consumer(self._subjects.order_stream, CONSUMER)
            return "waiting"
        return super().state_of(run)

    def follow(self, run: str, offset: int) -> Iterator[dict[str, Any]]:
        stream = self._subjects.run_stream
        limits = stream_settings(KEPT_DAYS, MAX_EVENTS_BYTES)
        self._client.ensure_mirror(stream, self._nats.domain, **limits)
        heard_s = quiet_s = time.monotonic()
        messages = self._client.read(stream, self._subjects.run(run), lambda: self._is_closed)
        with self._client.listening(self._subjects.beat) as beats, closing(messages):
            asked: dict[str, Any] = {}
            for data in messages:
                if data is None and beats.empty() and not asked:
                    self._check_heard(heard_s)
                    continue
                heard_s, self._has_contact = time.monotonic(), True
                while not beats.empty():
                    beats.get()
                if data is None:
                    if asked:
                        # nor did they come meanwhile
                        offset = int(asked["offset"])
                        yield {**asked, "note": _NOT_STORED}
                        if "over" in asked:
                            return
                        asked = {}
                    elif heard_s - quiet_s >= _QUIET_S:
                        asked, quiet_s = self._events_there(run, offset), heard_s
                    continue
                quiet_s, asked = heard_s, {}
                try:
                    value = verified(EVENTS, data, (self._worker,), "the worker")
                except EnvelopeRefused:
                    continue
                if (value.get("fleet"), value.get("site"), value.get("run")) != (self._fleet, self.site.name, run):
                    continue
                # what was published twice; a gap is what a stream has dropped, and the last event has all outcomes
                if int(value["end"]) > offset or "events" not in value:
                    offset = max(offset, int(value["end"]))
                    yield {**value, "offset": offset}
                if "over" in value:
                    return
        self._check_heard(heard_s)

    def _events_there(self, run: str, offset: int) -> dict[str, Any]:
        """The worker's output of a run from `offset` on; empty if there is none."""
        try:
            return self.ask({"do": "events", "run": run, "offset": offset})
        except WorkerError:
            # of an earlier version
            return {}

    def stop(self, run: str) -> bool:
        return bool(self.ask({"do": "stop", "run": run})["stopping"])

    def close(self) -> None:
        planned, self._planned = self._planned, []
        if planned and not self._is_closed:
            with suppress(Unreachable, InputError):
                request = self._request(secrets.token_hex(8), ReplyKey.new(), {"do": "finish", "runs": planned})
                self._client.send_chunks(self._subjects.ask, secrets.token_hex(8), request)
        self._is_closed = True
