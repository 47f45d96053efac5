"""A site: a place with nodes of its own, which a worker on the computer there provisions."""

from __future__ import annotations

from pydantic import Field

from meshctl.inventory.documents.base import Document
from meshctl.inventory.documents.node import SshLayer
from meshctl.inventory.fields import Line, Name, Whole


class NatsHubDocument(Document):
    """The NATS server (JetStream) that stores orders for sites until they are online."""

    url: Line
    """Its address for operators: `nats://HOST:PORT` or `tls://HOST:PORT`."""
    credentials: Line = ""
    """File with the operator's credentials: a `.creds` file or an nkey seed; relative to this file."""
    ca: Line = ""
    """Certificate authority of the server, PEM; relative to this file. Default: the system's."""
    domain: Name = "hub"
    """JetStream domain of the server."""
    order_hours: Whole = Field(default=24, ge=1, le=24 * 90)
    """How long an order waits for a site that is offline. Its worker refuses it later."""


class SiteNatsDocument(Document):
    """The NATS leaf node at a site, as its worker uses it there."""

    url: Line = "nats://127.0.0.1:4222"
    """Its address on the gateway."""
    domain: Name = ""
    """JetStream domain of the leaf node; default: the site's name."""


class SiteDocument(Document):
    """A site. With `ssh.host`, a worker on that computer provisions the site's nodes; with `nats`, it runs there
    permanently; without either, the operator provisions them."""

    ssh: SshLayer = Field(default_factory=SshLayer)
    """SSH login to the site's gateway, the computer with the worker."""
    nats: SiteNatsDocument | None = None
    """The permanent worker's NATS leaf node; `{}` for its defaults."""
    worker_key: Line = ""
    """SSH public key of the worker, which the site's nodes accept; written by `meshctl sites install`."""
