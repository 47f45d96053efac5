"""Sites over NATS need Debian's nats-server (scripts/setup-nats)."""

from __future__ import annotations

from tests.meshctl.sites.nats_servers import expects_nats

collect_ignore = [] if expects_nats() else ["test_sites_over_nats.py", "test_many_sites.py"]
