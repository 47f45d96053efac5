"""The answers of nodes as their site's worker passes them on, and when a worker is asked."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from meshctl.device.observe import RawObservation
from meshctl.device.traffic import TrafficMeter
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet.journal import Journal, LastKnown
from meshctl.inventory import load_fleet
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.desired import Renderer
from meshctl.sites.protocol import WorkerError
from meshctl.sites.uplink import Uplink
from meshctl.status.assess import Snapshot, assess
from meshctl.status.collect import Collector
from meshctl.status.filters import select_devices
from meshctl.status.site_observer import MAX_OUTPUT_BYTES, PERIOD_S, SiteObserver, answers_json, parse_answers
from meshctl.status.values import Level, NoAnswer
from meshctl.topology import Graph
from tests.meshctl.inventories import compex_hardware

_SAID = b"@@n boot_id 0\nb-1\n"
_ANSWERS: dict[str, RawObservation | NoAnswer] = {
    "n1": RawObservation("n", _SAID, 100.0, 101.5),
    "n2": NoAnswer("silent", "unreachable", "look"),
}
_ONE_ANSWER = (
    '{"now_s": 1, "sent_bytes": {}, '
    '"answers": {"n1": {"nonce": "n", "output": "%s", "asked_at_s": 1, "answered_at_s": 1}}}'
)
_SENT_BYTES = {"n1": 40_000, "n2": 60}


def test_answers_keep_their_age_although_the_clocks_of_both_sides_differ() -> None:
    found = parse_answers(json.dumps(answers_json(_ANSWERS, 110.0, {})), 5000.0).answers
    assert found["n2"] == _ANSWERS["n2"]
    assert found["n1"] == RawObservation("n", _SAID, 4990.0, 4991.5).interpret()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"now_s": 1}',
        '{"now_s": 1, "answers": {}, "sent_bytes": {"n1": []}}',
        '{"now_s": 1, "answers": {}}',
        '{"now_s": 1, "sent_bytes": {}, "answers": {"n1": {}}}',
        _ONE_ANSWER % "AAAA",
        _ONE_ANSWER % "-",
    ],
)
def test_what_is_not_answers_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        parse_answers(text, 0.0)


def test_an_answer_that_inflates_without_end_is_refused() -> None:
    output = base64.b64encode(zlib.compress(bytes(MAX_OUTPUT_BYTES + 1))).decode()
    said = {"nonce": "n", "output": output, "asked_at_s": 1, "answered_at_s": 1}
    with pytest.raises(ValueError, match="more than 16 MiB"):
        parse_answers(json.dumps({"now_s": 1, "answers": {"n1": said}, "sent_bytes": {}}), 0.0)


class Workers:
    """What the workers' uplinks do, and at what time."""

    def __init__(self, directory: Path) -> None:
        (directory / "fleet.yaml").write_text(_INVENTORY)
        self.now_s = 0.0
        self.opened = self.asked = self.closed = 0
        self.error: Exception | None = None
        self.text = json.dumps(answers_json(_ANSWERS, 110.0, _SENT_BYTES))
        fleet = load_fleet(directory, environ={})
        self.observer = SiteObserver(
            fleet, cast("ConnectionPool", None), lambda site: b"", lambda: 110.0, lambda: self.now_s, self._open
        )

    def _open(self, *about: object) -> Uplink:
        self.opened += 1
        return cast("Uplink", SimpleNamespace(status=self._status, close=self._close))

    def _close(self) -> None:
        self.closed += 1

    def _status(self, run: str, part: bytes, nodes: Sequence[str], options: Sequence[str]) -> str:
        self.asked += 1
        if self.error is not None:
            raise self.error
        return self.text

    def observe(self) -> Any:
        return self.observer.observe("north", ["n1", "n2"])


_INVENTORY = (
    """\
meshctl: 1
fleet: mines
country: US
operators: {ssh_keys: []}
hardware:
"""
    + compex_hardware("24.10")
    + """\
meshes:
  north: {ssid: north, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, network: 10.42.0.0/24}
sites:
  north:
    ssh: {host: 192.0.2.1, user: mesh}
    worker_key: ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8g worker
  south: {ssh: {host: 192.0.2.2, user: mesh}}
defaults: {hardware: box, state: deployed, radios: {radio0: {mesh: north}}}
nodes:
  n1: {role: base, site: north, address: 10.42.0.1}
  n2: {site: north, address: 10.42.0.2}
  s1: {site: south, address: 10.42.0.3}
  own: {address: 10.42.0.4}
"""
)


@pytest.fixture
def workers(tmp_path: Path) -> Workers:
    return Workers(tmp_path)


def test_only_a_site_whose_worker_is_installed_is_asked(workers: Workers) -> None:
    nodes = workers.observer.fleet.nodes
    assert {name: workers.observer.site_of(node) for name, node in nodes.items()} == {
        "n1": "north",
        "n2": "north",
        "s1": "",
        "own": "",
    }


def test_a_worker_is_asked_once_in_a_while_over_one_uplink(workers: Workers) -> None:
    first = workers.observe()
    workers.now_s = PERIOD_S - 1
    assert workers.observe() == first
    assert workers.asked == 1
    workers.now_s = PERIOD_S
    workers.observe()
    workers.observer.observe("north", ["n1"])
    assert (workers.asked, workers.opened) == (3, 1)
    workers.observer.close()
    assert workers.closed == 1


def test_bytes_on_the_air_of_a_site_are_counted_and_those_of_its_uplink_are_not(workers: Workers) -> None:
    meter = TrafficMeter()
    collector = Collector(
        workers.observer.fleet, cast("Renderer", None), cast("ConnectionPool", SimpleNamespace(meter=meter)),
        cast("Journal", None), "laptop", sites=workers.observer,
    )  # fmt: skip
    meter.add("own", 500)
    meter.add("site.north", 9_000)
    for _ in range(2):
        workers.observe()
        workers.now_s += PERIOD_S
    assert collector.traffic() == {"own": 500, "n1": 80_000, "n2": 120}


@pytest.mark.parametrize(
    ("error", "kind"), [(Unreachable("cut", hint="mend it"), Unreachable), (WorkerError("busy"), NodeError)]
)
def test_a_worker_that_fails_is_asked_again_over_a_new_uplink(
    workers: Workers, error: Exception, kind: type[NodeError]
) -> None:
    workers.observe()
    workers.now_s, workers.error = PERIOD_S, error
    with pytest.raises(kind) as raised:
        workers.observe()
    assert type(raised.value) is kind
    assert raised.value.gateway_of == "north"
    workers.error = None
    workers.observe()
    assert (workers.opened, workers.closed) == (2, 1)


def test_an_unusable_answer_is_the_sites_failure(workers: Workers) -> None:
    workers.text = "[]"
    with pytest.raises(NodeError, match="site north: its worker's answer is unusable"):
        workers.observe()


def test_the_alarm_of_a_silent_site_says_how_old_its_facts_are(workers: Workers) -> None:
    fleet = workers.observer.fleet
    why = NoAnswer("site north is not connected to the NATS hub", hint="check it", of_gateway=True)
    known = {"n1": LastKnown("n1", 1000.0, {}), "n2": LastKnown("n2", 400.0, {})}
    snapshot = Snapshot(
        fleet, {}, dict.fromkeys(("n1", "n2"), why), {}, {}, Graph(), known, {}, unusable_workers={"south": why}
    )
    assessed = assess(snapshot, fleet.nodes.values(), 1090.0)
    found = {alarm.level: alarm for alarm in assessed.alarms}
    assert found[Level.WARNING].text == (
        "no contact with site north (site north is not connected to the NATS hub): the last known state of its "
        "2 nodes is 90 s old"
    )
    assert found[Level.NOTE].text.startswith("the nodes of site south were queried from here, not by its worker")
    shown = {
        " ".join(words or alarms): [alarm.level.text for alarm in chosen.apply(assessed).alarms]
        for words, alarms in ((["site:north"], []), (["n1"], []), (["site:south"], []), ([], ["site"]), ([], ["drift"]))
        for chosen in [select_devices(fleet, words, Path.read_text, alarms=alarms)]  # type: ignore[arg-type]
    }
    assert shown == {
        "site:north": ["warning"],
        "n1": ["warning"],
        "site:south": ["note"],
        "site": ["note", "warning"],
        "drift": [],
    }
    nothing = assess(replace(snapshot, known={}), fleet.nodes.values(), 1090.0).alarms
    assert any("nothing is known of its 2 nodes" in alarm.text for alarm in nothing)
