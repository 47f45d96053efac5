"""Sites over NATS need Debian's nats-server (scripts/setup-nats)."""

from __future__ import annotations

from pathlib import Path

from tests.meshctl.sites.nats_servers import expects_nats

# what starts a server; looked for in the tests, since a list of these was once incomplete
_STARTS_SERVER = ("nats_servers", "nats_rig", "many_sites", "gateway_machine")
_NEED_SERVER = [
    path.name
    for path in Path(__file__).parent.glob("test_*.py")
    if any(f"tests.meshctl.sites.{module}" in path.read_text(encoding="utf-8") for module in _STARTS_SERVER)
]
collect_ignore = [] if expects_nats() else _NEED_SERVER
