"""A client of the daemon for any Python since 3.8, standard library only: `mesh_client` is a single file to copy."""

from udp_mesh.client.mesh_client import MeshClient, MeshError, Message, MessageOutcome

__all__ = ["MeshClient", "MeshError", "Message", "MessageOutcome"]
