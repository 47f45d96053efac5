"""What a permanent worker does with what a carrier brings it: orders that are late, repeated, changed or not for it."""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import pytest

from meshctl.archive import TarMember, tar_of
from meshctl.device.connection import Credentials, fingerprint_of
from meshctl.device.trust import parse_key
from meshctl.errors import InputError
from meshctl.sites import runner
from meshctl.sites.chunks import MAX_CHUNK_BYTES, MAX_MESSAGE_BYTES, Assembler, chunks_of, parse_chunk
from meshctl.sites.envelope import (
    EVENTS,
    REQUEST,
    EnvelopeRefused,
    ReplyKey,
    inflated,
    opened_reply,
    sealed_for_reply,
    sealed_for_worker,
    signed,
    verified,
)
from meshctl.sites.nats_client import NatsClient
from meshctl.sites.nats_worker import Complaint, NatsWorker
from meshctl.sites.order import ClockBehind, Order, OrderRefused, images_sha256, sign_order
from meshctl.sites.runs import RunDirectory, SiteDirectory, read_json
from tests.meshctl.device.servers import keypair, public

_RUN = "0123456789abcdef"
_PART = tar_of([TarMember("fleet.yaml", b"meshctl: 1\n")])
_NOW_S = 1_800_000_000.0


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


class Site:
    """A worker without a connection, an operator's key, and an order for it."""

    def __init__(self, directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.key = keypair(directory / "operator")
        self.directory = SiteDirectory.of("mines/north", {"XDG_STATE_HOME": str(directory)})
        self.worker_key = self.directory.install([public(self.key).read_text().strip()])
        self.now_s = _NOW_S
        client = cast("NatsClient", None)
        self.worker = NatsWorker(self.directory, {}, client, "hub", lambda: self.now_s)
        self.started: list[str] = []
        monkeypatch.setattr(runner, "start", lambda _directory, order, _environ: self._start(order.text))
        self.order = Order(
            "mines", "north", _RUN, "apply", "alice@laptop", "", "", None, _NOW_S, _NOW_S + 3600, images_sha256({})
        )

    def _start(self, text: str) -> object:
        self.started.append(json.loads(text)["run"])
        self.run.order.write_text("{}")
        return None

    @property
    def run(self) -> RunDirectory:
        return self.directory.run(_RUN)

    def message(self, ordered: Order, key: Path | None = None, **changes: Any) -> bytes:
        own = key or self.key
        fingerprint = fingerprint_of(parse_key(public(own).read_text()).blob)
        made = sign_order(ordered, Credentials((own,), use_agent=False), [fingerprint])
        value = {"order": made.text, "key": made.key, "signature": made.signature, "plan": "{}", "images": {}}
        value |= {"part": base64.b64encode(_PART).decode(), **changes}
        return sealed_for_worker(json.dumps(value).encode(), self.worker_key)

    def execute(self, data: bytes) -> None:
        self.worker._execute(data)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    return Site(tmp_path, monkeypatch)


def test_an_order_is_executed_once_however_often_it_is_delivered(site: Site) -> None:
    for _ in range(3):
        site.execute(site.message(site.order))
    assert site.started == [_RUN]
    assert (site.run.inventory / "fleet.yaml").exists()
    site.run.discard()
    (site.directory.root / "forgotten").write_text(f"{_RUN}\n")
    site.execute(site.message(site.order))
    assert site.started == [_RUN]


@pytest.mark.parametrize("left", [("inventory",), ("inventory", "plan.json")], ids=["no plan", "half a plan"])
def test_an_order_whose_unpacking_was_cut_is_unpacked_again(site: Site, left: tuple[str, ...]) -> None:
    """A full disk or a power cut ends it anywhere; the hub delivers the order again."""
    ordered = replace(site.order, part_sha256=_sha256(_PART), plan_sha256=_sha256(b"{}"))
    site.run.inventory.mkdir(parents=True)
    if "plan.json" in left:
        site.run.plan.write_bytes(b"{")
    site.execute(site.message(ordered))
    assert site.started == [_RUN]
    assert site.run.plan_sha256() == ordered.plan_sha256
    assert site.run.part_sha256() == ordered.part_sha256
    assert (site.run.inventory / "fleet.yaml").exists()


def test_an_order_for_what_was_planned_here_is_not_unpacked_again(site: Site) -> None:
    ordered = replace(site.order, part_sha256=_sha256(_PART), plan_sha256=_sha256(b"{}"))
    site.run.create(_PART, {})
    site.run.plan.write_bytes(b"{}")
    (site.run.inventory / "planned here").touch()
    site.execute(site.message(ordered))
    assert site.started == [_RUN]
    assert (site.run.inventory / "planned here").exists()


def test_a_reason_that_stays_the_same_is_logged_once(capsys: pytest.CaptureFixture[str]) -> None:
    complaint = Complaint("no orders: ", "orders again")
    for reason in ("", "no answer", "no answer", "no room", "", "", "no answer"):
        complaint(reason)
    logged = ["no orders: no answer", "no orders: no room", "orders again", "no orders: no answer"]
    assert capsys.readouterr().err.splitlines() == logged


def test_an_expired_order_is_refused_for_ever_and_leaves_no_secret(site: Site) -> None:
    site.now_s = _NOW_S + 3601
    site.execute(site.message(site.order))
    assert "expired at 2027-01-15 09:00 UTC" in read_json(site.run.refused)["error"]
    assert site.run.state().state == "refused"
    assert not site.run.inventory.exists()
    reply = site.run.next_reply(0, 100)
    assert reply is not None
    assert reply["over"]["is_refused"]
    site.now_s = _NOW_S
    site.execute(site.message(site.order))
    assert site.started == []


def test_an_order_waits_until_the_clock_of_the_gateway_is_right(site: Site) -> None:
    site.now_s = 0.0
    with pytest.raises(ClockBehind, match="the clock here says 1970-01-01 00:00 UTC"):
        site.execute(site.message(site.order))
    assert not site.run.path.exists()
    site.now_s = _NOW_S
    site.execute(site.message(site.order))
    assert site.started == [_RUN]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"expires_s": None}, "without an expiry"),
        ({"images_sha256": images_sha256({"x": "y"})}, "other firmware images"),
    ],
)
def test_an_order_that_cannot_wait_is_refused(site: Site, changes: dict[str, Any], reason: str) -> None:
    site.execute(site.message(replace(site.order, **changes)))
    assert reason in read_json(site.run.refused)["error"]
    assert site.started == []


def test_what_is_no_operators_order_for_this_site_leaves_nothing(site: Site, tmp_path: Path) -> None:
    stranger = keypair(tmp_path / "stranger")
    for data in (
        site.message(site.order, stranger),
        site.message(replace(site.order, site="south")),
        site.message(site.order, order=json.dumps(asdict(replace(site.order, run="f" * 16)))),
    ):
        with pytest.raises(OrderRefused):
            site.execute(data)
    with pytest.raises(EnvelopeRefused):
        site.execute(b"not sealed")
    assert not site.run.path.exists()
    assert site.started == []


def test_an_envelope_is_for_one_purpose_and_from_one_sender(site: Site, tmp_path: Path) -> None:
    worker, other = parse_key(site.worker_key), parse_key(public(keypair(tmp_path / "other")).read_text())
    data = signed(EVENTS, {"run": _RUN}, site.worker.sign)
    assert verified(EVENTS, data, [worker], "the worker") == {"run": _RUN}
    for purpose, accepted, changed in (
        (REQUEST, worker, data),
        (EVENTS, other, data),
        (EVENTS, worker, data.replace(b"0123", b"1123")),
        (EVENTS, worker, b"{}"),
        (EVENTS, worker, b"\xff"),
    ):
        with pytest.raises(EnvelopeRefused):
            verified(purpose, changed, [accepted], "the worker")


def test_a_reply_is_read_with_the_key_of_its_request_alone() -> None:
    key, other = ReplyKey.new(), ReplyKey.new()
    sealed = sealed_for_reply(b"a plan", key.recipient)
    assert opened_reply(sealed, ReplyKey.load(key.text)) == b"a plan"
    with pytest.raises(EnvelopeRefused):
        opened_reply(sealed, other)
    with pytest.raises(EnvelopeRefused):
        sealed_for_reply(b"", "age1none")
    with pytest.raises(InputError):
        sealed_for_worker(b"", "ecdsa-sha2-nistp256 AAAA")


def test_a_small_message_that_would_fill_the_memory_is_refused() -> None:
    assert inflated(zlib.compress(b"a request")) == b"a request"
    for data in (zlib.compress(bytes(MAX_MESSAGE_BYTES + 1)), zlib.compress(b"a request")[:-4], b"not compressed"):
        with pytest.raises(EnvelopeRefused):
            inflated(data)


def test_a_message_is_put_together_from_its_pieces_in_any_order() -> None:
    data = bytes(range(256)) * (MAX_CHUNK_BYTES // 256 * 2 + 1)
    pieces = [parse_chunk(chunk.header, chunk.data) for chunk in chunks_of("a", data)]
    assert len(pieces) == 3
    assembler = Assembler()
    found = [assembler.add(pieces[number]) for number in (2, 0, 0, 1)]
    assert found == [None, None, None, data]
    for header in ("", "a", "a 1", "a 0/1", "a 2/1", "a 1/99999", "a x/y"):
        with pytest.raises(ValueError, match=r"."):
            parse_chunk(header, b"")
