"""Talks to a running daemon from any Python since 3.8, with the standard library alone: `mesh_client` is one file to
copy."""

from udp_mesh.client.mesh_client import MeshClient, MeshError, Message

__all__ = ["MeshClient", "MeshError", "Message"]
