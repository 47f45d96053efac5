"""Orders for sites: signed by the operator, good for a time, and what sites replace that were offline meanwhile."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

from meshctl.cli.context import Session
from meshctl.fleet.journal import Run
from meshctl.fleet.process import owner
from meshctl.fleet.run_files import BEFORE, REPLY_KEYS, RunFiles
from meshctl.nodes.site_gateways import gateway_credentials
from meshctl.sites.dispatch import SitePlan, SiteRun
from meshctl.sites.envelope import ReplyKey, opened_replaced
from meshctl.sites.order import Order, images_sha256, sign_order
from meshctl.sites.runs import PREPARED_S
from meshctl.sites.uplink import Parcel


def signed_order(
    opened: Session, site: SitePlan, command: str, rate_kb_s: float | None, key: ReplyKey | None
) -> Parcel:
    """The order for a site's plan; `key` is for what it replaces, if the operator does not have that yet."""
    assert site.uplink is not None, "a site with a plan has an uplink"
    assert site.bundle is not None, "a site with a plan has a bundle"
    plan_sha256 = hashlib.sha256(site.text.encode()).hexdigest()
    now_s = time.time()
    order = Order(
        opened.fleet.name,
        site.site.name,
        site.run,
        command,
        owner(),
        plan_sha256,
        site.bundle.sha256,
        rate_kb_s,
        now_s,
        now_s + _lifetime_s(opened, site) if site.site.nats is not None else None,
        images_sha256(site.bundle.images),
        key.recipient if key is not None else "",
    )
    accepted = site.uplink.accepted_keys
    access = opened.access
    credentials = gateway_credentials(opened.fleet, site.site, access.key_files, use_agent=access.use_agent)
    signed = sign_order(order, credentials, accepted)
    return Parcel(signed, site.run, site.bundle.archive, site.text, site.bundle.images)


def _lifetime_s(opened: Session, site: SitePlan) -> float:
    """How long an order waits for its site: one that was online is expected back soon."""
    assert opened.fleet.nats is not None, "a site with `nats` and a plan has a hub"
    return opened.fleet.nats.order_hours * 3600.0 if site.is_queued else PREPARED_S


def expiry(opened: Session, site: SitePlan) -> str:
    """Until when an order for the site is good, in words."""
    return datetime.fromtimestamp(time.time() + _lifetime_s(opened, site), UTC).strftime("%Y-%m-%d %H:%M UTC")


@dataclass(frozen=True, slots=True)
class LateReplaced:
    """What sites replace that were offline when their plans were ordered: it comes with the events of their runs, and
    only the computer that gave the order can read it."""

    opened: Session
    entry: Run
    # sites report at the same time, and all of them are in one file
    _guard: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def _files(self) -> RunFiles:
        return RunFiles(self.opened.journal.path)

    def expect(self, keys: Mapping[str, ReplyKey]) -> None:
        """Keep the keys to read it with: run of a site -> key."""
        if keys:
            self._files().save(self.entry.id, REPLY_KEYS, {run: key.text for run, key in keys.items()})

    def keep(self, run: SiteRun, sealed: str) -> None:
        """Save it for `meshctl rollback`. Raises MeshctlError."""
        files = self._files()
        key = (files.load(self.entry.id, REPLY_KEYS) or {}).get(run.run)
        if key is not None:
            found = opened_replaced(sealed, ReplyKey.load(str(key)))
            own = {name: state for name, state in found.items() if name in run.nodes}
            with self._guard:
                files.save(self.entry.id, BEFORE, {**(files.load(self.entry.id, BEFORE) or {}), **own})
