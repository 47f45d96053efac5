"""Intent -> the files of a node, byte-for-byte deterministic; each UCI file is parsed back before use."""

from meshctl.render.compare import (
    FileDifference,
    NodeChange,
    NodeDifference,
    compare_files,
    compare_fleets,
    compare_nodes,
)
from meshctl.render.daemon import daemon_config, daemon_keys
from meshctl.render.facts import DeviceFacts, with_switch
from meshctl.render.imagebuilder import ImageFolder, folder_files, image_folders
from meshctl.render.node import UnknownNode, render, render_fleet, render_node, render_nodes
from meshctl.render.rendered import CONFIG_FOLDER, LAN_FILTER_PATH, MARKER_PATH, Rendered, RenderedFile
from meshctl.render.templates import Templates
from meshctl.render.write import write_folder, write_node

__all__ = [
    "CONFIG_FOLDER",
    "LAN_FILTER_PATH",
    "MARKER_PATH",
    "DeviceFacts",
    "FileDifference",
    "ImageFolder",
    "NodeChange",
    "NodeDifference",
    "Rendered",
    "RenderedFile",
    "Templates",
    "UnknownNode",
    "compare_files",
    "compare_fleets",
    "compare_nodes",
    "daemon_config",
    "daemon_keys",
    "folder_files",
    "image_folders",
    "render",
    "render_fleet",
    "render_node",
    "render_nodes",
    "with_switch",
    "write_folder",
    "write_node",
]
