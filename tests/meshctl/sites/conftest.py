"""Sites over NATS need Debian's nats-server (scripts/setup-nats)."""

from __future__ import annotations

from tests.meshctl.sites.nats_servers import expects_nats

_NEED_SERVER = [
    "test_gateway_machine.py",
    "test_many_sites.py",
    "test_nats_authorization.py",
    "test_nats_lost_stores.py",
    "test_sites_over_nats.py",
]
collect_ignore = [] if expects_nats() else _NEED_SERVER
