"""All generated files by name."""

from __future__ import annotations

from docgen import commands, markdown, metrics, roff


def pages() -> dict[str, str]:
    """Markdown pages of the site's reference."""
    from meshctl.inventory.json_schema import json_schema

    return {
        "cli-meshctl.md": markdown.command_page(commands.meshctl()),
        "cli-udp-mesh.md": markdown.command_page(commands.udp_mesh()),
        "inventory-keys.md": markdown.inventory_page(json_schema()),
        "daemon-configuration.md": markdown.daemon_page(),
        "metrics.md": metrics.metrics_page(),
    }


def man_pages() -> dict[str, str]:
    """Man pages, section 1."""
    from meshctl import __version__

    return {f"{program.name}.1": roff.man_page(program, __version__) for program in commands.programs()}
