"""The tests with a real prometheus are collected where there is one (scripts/setup-prometheus)."""

from __future__ import annotations

from tests.meshctl.monitor.prometheus_program import expects_prometheus

collect_ignore = [] if expects_prometheus() else ["test_prometheus.py"]
