"""The metrics, rules, targets and dashboard hold with Debian's real prometheus."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
import yaml

from meshctl.device.observation import MeshTableSizes, Sensors
from meshctl.inventory import load_fleet
from meshctl.model import Fleet
from meshctl.monitor.exposition import CONTENT_TYPE
from meshctl.monitor.frame import Airtime, Frame, frame_of
from meshctl.monitor.metrics import metric_families, render_metrics
from meshctl.monitor.prometheus import alert_rules, dashboard, file_sd
from meshctl.status import preflight
from meshctl.status.json_output import as_json
from tests.meshctl.monitor.prometheus_program import Prometheus, free_tcp_port, promtool, running
from tests.meshctl.status.fleets import HEALTHY, INVENTORY, NOW, TEAM, peer, queue, robot_facts, status_of, trio
from tests.udp_mesh.daemon.processes import two_daemons
from tests.waiting import until

HOSTILE = 'b"\\\n}} 1\x00\u2028\U0001f916'


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    return trio(tmp_path)


def frame_with_everything(fleet: Fleet) -> Frame:
    """A fleet that reports all that there is to report, and that is ill."""
    rover = replace(
        HEALTHY["rover"],
        sensors=Sensors({"phy0": 101}, {"phy0": 61.5}),
        mesh_statistics={"bat0": {"tx_bytes": 5000, "forward_bytes": 70}},
        mesh_tables={"bat0": MeshTableSizes(2, 1, 7, 0)},
        stations=tuple(
            replace(
                one, tx_packets=1000, tx_retries=300, tx_failed=2, tx_mbit_s=65.0, rx_mbit_s=58.5, expected_mbit_s=30.0
            )
            for one in HEALTHY["rover"].stations or ()
        ),
    )
    station = peer("station", outbox_messages=3, capacity_bits_per_s=4e6)
    facts = robot_facts("rover", station, queues=(queue(0, 2, 5.5), queue(5, 9, 1.0)))
    status = as_json(status_of(fleet, {**HEALTHY, "rover": rover}, {**TEAM, "rover": facts}))
    status["nodes"][1]["neighbours"][0]["name"] = HOSTILE
    checks = preflight(fleet, status_of(fleet))
    return frame_of(status, time_s=NOW, checks=checks, airtime=Airtime(900.0, 0.01, 0.03, 5.0))


@contextmanager
def served(page: Callable[[], str]) -> Iterator[str]:
    """A web server with the page at /metrics: its host and port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = page().encode()
            self.send_response(200)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *arguments: object) -> None:
            """Nothing."""

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def expressions() -> list[str]:
    """Of the dashboard's panels and of the rules."""
    panels = json.loads(dashboard())["panels"]
    found = [target["expr"] for panel in panels for target in panel["targets"]]
    found += [rule["expr"] for group in yaml.safe_load(alert_rules())["groups"] for rule in group["rules"]]
    return [one.replace("$fleet", ".*") for one in found]


def test_prometheus_scrapes_radios_and_daemons_and_knows_every_metric_of_dashboard_and_rules(
    fleet: Fleet, tmp_path: Path
) -> None:
    frame = frame_with_everything(fleet)
    port = free_tcp_port()
    with (
        two_daemons(alice_more=f'metrics_address = "127.0.0.1:{port}"') as (alice, _),
        served(lambda: render_metrics(frame)) as target,
        running(tmp_path, {"meshctl": target, "udp_mesh": f"127.0.0.1:{port}"}, rules=alert_rules()) as server,
    ):
        with alice.client() as client:
            client.request("set-radio", b'{"source": "alice-radio", "problem": null, "paths": [], "neighbors": []}')
            for _ in range(20):
                client.request("publish", payload=b"stop", topic="status", to="bob")
        until(lambda: set(server.query("up").values()) == {1.0} and len(server.query("up")) == 2, "both to be scraped")
        until(lambda: server.query('udp_mesh_delivery_latency_seconds_count{priority="0"} >= 20'), "the deliveries")
        names = set(server.get("label/__name__/values"))
        families = {family.name for family in metric_families(frame)}
        # of nodes with a LAN filter, or that were compared; these have none
        without = {"meshctl_node_drift", "meshctl_node_lan_filter_dropped_packets_total", "batman_tx"}
        assert families <= names | without, families - names
        for expression in expressions():
            server.query(expression)
            used = set(re.findall(r"\b(?:meshctl|wifi|node|batman|udp_mesh)_[a-z0-9_]+", expression))
            assert used <= names, expression
        assert server.query('meshctl_link_snr_db{from="rover"}') == {
            json.dumps({"from": "rover", "instance": target, "mesh": "main", "to": "b01"}, sort_keys=True): 35.0
        }
        (labels,) = server.query('wifi_station_signal_dbm{node="b01",neighbor!="rover"}')
        assert json.loads(labels)["neighbor"] == HOSTILE
        assert server.query('sum(batman_originator_count{node="rover"})') == {"{}": 3.0}
        assert min(server.query("udp_mesh_peer_delivered_bytes_total").values()) > 0
        assert list(server.query("node_boot_time_seconds").values()) == [NOW - 1 - 5000] * 3
        rules: Any = server.get("rules")
        assert {rule["health"] for group in rules["groups"] for rule in group["rules"]} <= {"ok", "unknown"}
        until(lambda: firing(server) >= {"MeshMonitorStale", "MeshUrgentQueue"}, "alerts without a delay to fire")


def firing(server: Prometheus) -> set[str]:
    return {alert["labels"]["alertname"] for alert in server.get("alerts")["alerts"] if alert["state"] == "firing"}


RULE_TESTS = """
rule_files: [rules.yml]
evaluation_interval: 15s
tests:
  - interval: 15s
    input_series:
      - {series: 'meshctl_node_up{node="b01", state="deployed"}', values: "1 1 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0"}
      - {series: 'meshctl_node_up{node="b02", state="carried"}', values: "0x17"}
      - {series: 'meshctl_alarm{device="b01", code="join", level="error", silenced="false"}', values: "1x17"}
      - {series: 'meshctl_alarm{device="b02", code="join", level="error", silenced="true"}', values: "1x17"}
      - {series: 'meshctl_alarm{device="b03", code="weak", level="warning", silenced="false"}', values: "1x17"}
      - {series: 'meshctl_link_snr_db{from="b01", to="b02", mesh="main"}', values: "9x17"}
      - {series: 'meshctl_link_quality_ratio{from="b01", to="b02", mesh="main"}', values: "0.8x17"}
      - {series: 'meshctl_link_snr_db{from="b03", to="b02", mesh="main"}', values: "10x17"}
      - {series: 'meshctl_link_quality_ratio{from="b03", to="b02", mesh="main"}', values: "0.8x17"}
      - {series: 'meshctl_radio_busy_ratio{node="b01"}', values: "0.81x17"}
      - {series: 'meshctl_radio_queue_packets{node="b01"}', values: "101x17"}
      - {series: 'meshctl_radio_queue_packets{node="b02"}', values: "100x17"}
      - {series: 'meshctl_go{fleet="lab"}', values: "0x17"}
      - {series: 'meshctl_frame_timestamp_seconds{fleet="lab"}', values: "0x17"}
      - {series: 'meshctl_watch_interval_seconds{fleet="lab"}', values: "5x17"}
      - {series: 'meshctl_robot_queue_oldest_seconds{robot="spot", priority="1"}', values: "3x17"}
      - {series: 'udp_mesh_peer_online{instance="spot", peer="husky"}', values: "0x17"}
      - {series: 'udp_mesh_delivery_latency_seconds_bucket{instance="a", priority="0", le="1.0"}', values: "0+1x17"}
      - {series: 'udp_mesh_delivery_latency_seconds_bucket{instance="a", priority="0", le="2.0"}', values: "0+10x17"}
      - {series: 'udp_mesh_delivery_latency_seconds_bucket{instance="a", priority="0", le="+Inf"}', values: "0+10x17"}
      - {series: 'udp_mesh_radio_report_age_seconds{instance="spot"}', values: "1 1 16+15x15"}
      - {series: 'udp_mesh_radio_report_age_seconds{instance="husky"}', values: "9x17"}
      - {series: 'udp_mesh_radio_problem{instance="spot"}', values: "0x17"}
      - {series: 'udp_mesh_radio_problem{instance="husky"}', values: "1x17"}
    alert_rule_test:
EXPECTED
"""


def test_every_rule_fires_for_what_it_names_and_for_nothing_else(tmp_path: Path) -> None:
    rules = yaml.safe_load(alert_rules())
    severity = {rule["alert"]: rule["labels"]["severity"] for group in rules["groups"] for rule in group["rules"]}
    labels = {
        "MeshMonitorStale": "{fleet: lab}",
        "MeshNoGo": "{fleet: lab}",
        "MeshNodeDown": "{node: b01, state: deployed}",
        "MeshAlarm": '{device: b01, code: join, level: error, silenced: "false"}',
        "MeshWarning": '{device: b03, code: weak, level: warning, silenced: "false"}',
        "MeshLinkWeak": "{from: b01, to: b02, mesh: main}",
        "MeshRadioQueue": "{node: b01}",
        "MeshChannelBusy": "{node: b01}",
        "MeshUrgentQueue": '{robot: spot, priority: "1"}',
        "UdpMeshPeerOffline": "{instance: spot, peer: husky}",
        "UdpMeshUrgentSlow": "{instance: a}",
        "UdpMeshCollectorSilent": "{instance: spot}",
        "UdpMeshRadioProblem": "{instance: husky}",
    }
    assert set(severity) == set(labels)
    # promtool compares annotations, too; their text is the rules' own
    lines = []
    for name, found in labels.items():
        expected = f"[{{exp_labels: {found[:-1]}, severity: {severity[name]}}}}}]"
        lines.append(f"      - {{eval_time: 4m, alertname: {name}, exp_alerts: {expected}}}")
    groups = [{**group, "rules": [without_annotations(rule) for rule in group["rules"]]} for group in rules["groups"]]
    bare = {"groups": groups}
    (tmp_path / "rules.yml").write_text(yaml.safe_dump(bare))
    (tmp_path / "tests.yml").write_text(RULE_TESTS.replace("EXPECTED", "\n".join(lines)))
    promtool("test", "rules", str(tmp_path / "tests.yml"))
    (tmp_path / "shipped.yml").write_text(alert_rules())
    assert f"{len(labels)} rules found" in promtool("check", "rules", str(tmp_path / "shipped.yml"))


def without_annotations(rule: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in rule.items() if name != "annotations"}


def test_radios_with_an_exporter_are_targets(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    with_exporter = INVENTORY.replace(
        "address: 10.42.0.2}", "address: 10.42.0.2, packages: [prometheus-node-exporter-lua]}"
    )
    path.write_text(with_exporter)
    text = file_sd(load_fleet(path))
    with running(tmp_path, {}, file_sd=text) as server:
        active = until(lambda: server.get("targets")["activeTargets"] or None, "the targets to be read")
    (target,) = active
    assert target["discoveredLabels"]["__address__"] == "10.42.0.2:9100"
    assert {name: target["labels"][name] for name in ("fleet", "node", "role")} == {
        "fleet": "trio",
        "node": "b01",
        "role": "beacon",
    }


def test_robots_daemons_are_scraped_at_the_addresses_that_their_ports_are_forwarded_to(tmp_path: Path) -> None:
    port = free_tcp_port()
    path = tmp_path / "fleet.yaml"
    path.write_text(f"{INVENTORY}udp_mesh: {{metrics_port: {port}}}\n")
    # as with `ssh -L 127.42.0.14:PORT:127.0.0.1:PORT rover`
    with (
        two_daemons(alice_more=f'metrics_address = "127.42.0.14:{port}"'),
        running(tmp_path, {}, file_sd=file_sd(load_fleet(path))) as server,
    ):
        until(lambda: len(server.query("up")) == 3, "every target to be scraped")
        until(lambda: server.query('udp_mesh_peer_online{instance="rover"}'), "the peers of rover's daemon")
        (labels,) = server.query('udp_mesh_info{robot="rover"}')
        up = {json.loads(one)["robot"]: value for one, value in server.query("up").items()}
    assert json.loads(labels)["name"] == "alice"
    assert up == {"station": 0.0, "rover": 1.0, "shelf": 0.0}
