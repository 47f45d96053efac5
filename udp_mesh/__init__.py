"""Prioritized messages between robots over unicast and broadcast UDP.

The flow: bytes -> frame -> session -> scheduler -> message (docs/design.md, docs/wire-format.md).

Use it as a library with `from udp_mesh import Node, Settings, Topic, Key`. Names are imported on first use, so that
the client and the bridges, which import this package on older Pythons, load nothing else.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from udp_mesh.client.mesh_client import MeshClient as MeshClient
    from udp_mesh.client.mesh_client import MeshError as MeshError
    from udp_mesh.client.mesh_client import Message as Message
    from udp_mesh.client.mesh_client import MessageOutcome as MessageOutcome
    from udp_mesh.core.events import ExpiryReason as ExpiryReason
    from udp_mesh.core.events import MessageDelivered as MessageDelivered
    from udp_mesh.core.events import MessageExpired as MessageExpired
    from udp_mesh.core.events import MessagePeerLost as MessagePeerLost
    from udp_mesh.core.events import MessageReceived as MessageReceived
    from udp_mesh.core.events import PeerOffline as PeerOffline
    from udp_mesh.core.events import PeerOnline as PeerOnline
    from udp_mesh.core.events import RejectReason as RejectReason
    from udp_mesh.core.settings import Limits as Limits
    from udp_mesh.core.settings import Log as Log
    from udp_mesh.core.settings import Neighbour as Neighbour
    from udp_mesh.core.settings import Outbox as Outbox
    from udp_mesh.core.settings import Rates as Rates
    from udp_mesh.core.settings import Settings as Settings
    from udp_mesh.core.settings import Topic as Topic
    from udp_mesh.crypto.keys import Key as Key
    from udp_mesh.daemon.api_node import Node as Node
    from udp_mesh.daemon.api_node import SendRefusedError as SendRefusedError
    from udp_mesh.daemon.outbox import DirectoryStore as DirectoryStore
    from udp_mesh.links.attachments import LinkConfig as LinkConfig

__version__ = "0.6.0"

_EXPORTS = {
    "Node": "udp_mesh.daemon.api_node",
    "SendRefusedError": "udp_mesh.daemon.api_node",
    "LinkConfig": "udp_mesh.links.attachments",
    "DirectoryStore": "udp_mesh.daemon.outbox",
    "Settings": "udp_mesh.core.settings",
    "Topic": "udp_mesh.core.settings",
    "Outbox": "udp_mesh.core.settings",
    "Rates": "udp_mesh.core.settings",
    "Limits": "udp_mesh.core.settings",
    "Neighbour": "udp_mesh.core.settings",
    "MessageReceived": "udp_mesh.core.events",
    "MessageDelivered": "udp_mesh.core.events",
    "MessageExpired": "udp_mesh.core.events",
    "MessagePeerLost": "udp_mesh.core.events",
    "PeerOnline": "udp_mesh.core.events",
    "PeerOffline": "udp_mesh.core.events",
    "Key": "udp_mesh.crypto.keys",
    "ExpiryReason": "udp_mesh.core.events",
    "RejectReason": "udp_mesh.core.events",
    "Log": "udp_mesh.core.settings",
    "MeshClient": "udp_mesh.client.mesh_client",
    "MeshError": "udp_mesh.client.mesh_client",
    "Message": "udp_mesh.client.mesh_client",
    "MessageOutcome": "udp_mesh.client.mesh_client",
}


def __getattr__(name: str) -> object:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'udp_mesh' has no attribute {name!r}")
    return getattr(importlib.import_module(_EXPORTS[name]), name)
