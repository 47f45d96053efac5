"""A site: a place with nodes of its own, which a worker on the computer there provisions."""

from __future__ import annotations

from pydantic import Field

from meshctl.inventory.documents.base import Document
from meshctl.inventory.documents.node import SshLayer
from meshctl.inventory.fields import Line


class SiteDocument(Document):
    """A site. With `ssh.host`, a worker on that computer provisions the site's nodes; without, the operator does."""

    ssh: SshLayer = Field(default_factory=SshLayer)
    """SSH login to the site's gateway, the computer with the worker."""
    worker_key: Line = ""
    """SSH public key of the worker, which the site's nodes accept; written by `meshctl sites install`."""
