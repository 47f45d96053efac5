"""Hints for errors that the daemon reports."""

from udp_mesh.client.mesh_client import MeshError


def hint(error: MeshError) -> str:
    """The remedy for an error, if known."""
    match error.code, error.__cause__:
        case "unreachable", PermissionError():
            return "run as root or as a member of the group in `socket_group` of [daemon]"
        case "unreachable", FileNotFoundError() | ConnectionRefusedError():
            return "start it with `udp-mesh run`, or set --socket or UDP_MESH_SOCKET"
        case "unknown-peer", _:
            return "run `udp-mesh peers` for the known peers"
        case "cannot-record", _ if "File exists" not in str(error):
            return "the daemon writes the file; as a service it may do so only below /var/lib/udp-mesh"
        case "unknown-topic", _:
            return "run `udp-mesh topics` for the configured topics"
        case _:
            return ""
