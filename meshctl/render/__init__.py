"""Intent -> the files of a node, byte-for-byte deterministic; each UCI file is parsed back before use.

`compare`, `imagebuilder` and `write` are imported from their modules: only `meshctl render` and `meshctl diff` need
them.
"""

from meshctl.render.daemon import daemon_config, daemon_keys
from meshctl.render.facts import DeviceFacts, with_switch
from meshctl.render.node import UnknownNode, render, render_fleet, render_node, render_nodes
from meshctl.render.rendered import CONFIG_FOLDER, LAN_FILTER_PATH, LINKS_PATH, MARKER_PATH, Rendered, RenderedFile
from meshctl.render.templates import Templates

__all__ = [
    "CONFIG_FOLDER",
    "LAN_FILTER_PATH",
    "LINKS_PATH",
    "MARKER_PATH",
    "DeviceFacts",
    "Rendered",
    "RenderedFile",
    "Templates",
    "UnknownNode",
    "daemon_config",
    "daemon_keys",
    "render",
    "render_fleet",
    "render_node",
    "render_nodes",
    "with_switch",
]
