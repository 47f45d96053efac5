"""Intent -> the files of a node, deterministic to the byte, each UCI file parsed back before it leaves."""

from meshctl.render.node import DeviceFacts, UnknownNode, render, render_fleet, render_node
from meshctl.render.rendered import CONFIG_FOLDER, MARKER_PATH, Rendered, RenderedFile
from meshctl.render.templates import Templates

__all__ = [
    "CONFIG_FOLDER",
    "MARKER_PATH",
    "DeviceFacts",
    "Rendered",
    "RenderedFile",
    "Templates",
    "UnknownNode",
    "render",
    "render_fleet",
    "render_node",
]
