"""`set`, `drop`, `reload`: change the running daemon. Changes last until the next reload or restart."""

from __future__ import annotations

import argparse
import re
import tomllib
from typing import Any

from udp_mesh.cli.output import Exit, print_error, print_json, print_text
from udp_mesh.client.mesh_client import MeshClient


def set_topic(arguments: argparse.Namespace) -> int:
    values = _values(arguments.values)
    if values is None:
        return Exit.USAGE
    # TOML has no null, so "none" unsets a value; an outbox can itself be "none".
    cleared = {key: None for key, value in values.items() if value == "none" and key != "outbox"}
    return _change(arguments, "set-topic", topic=arguments.topic, values=values | cleared)


def set_window(arguments: argparse.Namespace) -> int:
    window: str | int = int(arguments.window) if re.fullmatch("[0-9]{1,9}", arguments.window) else arguments.window
    return _change(arguments, "set-window", window=window)


def set_rates(arguments: argparse.Namespace) -> int:
    values = _values(arguments.values)
    return Exit.USAGE if values is None else _change(arguments, "set-rates", values=values)


def set_position(arguments: argparse.Namespace) -> int:
    with MeshClient(arguments.socket) as mesh:
        mesh.request("set-position", x_m=arguments.x, y_m=arguments.y, z_m=arguments.z, frame=arguments.frame)
    if arguments.json:
        print_json({"changes": ["position"]})
    return Exit.OK


def set_neighbour(arguments: argparse.Namespace) -> int:
    return _change(
        arguments,
        "set-neighbor",
        address=arguments.address,
        name=arguments.name,
        link=arguments.link,
        legacy=arguments.legacy,
    )


def set_keys(arguments: argparse.Namespace) -> int:
    return _change(arguments, "set-keys", file=str(arguments.file.absolute()))


def drop_topic(arguments: argparse.Namespace) -> int:
    return _change(arguments, "drop-topic", topic=arguments.topic)


def drop_neighbour(arguments: argparse.Namespace) -> int:
    return _change(arguments, "drop-neighbor", address=arguments.address)


def reload(arguments: argparse.Namespace) -> int:
    return _change(arguments, "reload")


def _change(arguments: argparse.Namespace, op: str, **fields: Any) -> int:
    with MeshClient(arguments.socket) as mesh:
        changes = mesh.request(op, **fields)["changes"]
    if arguments.json:
        print_json({"changes": changes})
    else:
        print_text("\n".join(changes) if changes else "no changes")
    return Exit.OK


def _values(assignments: list[str]) -> dict[str, Any] | None:
    """`priority=2 outbox=last` as TOML values; a word without quotes is a string. Prints an error and returns None for
    an invalid assignment."""
    values: dict[str, Any] = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or not key:
            print_error(f"expected key=value, found {assignment!r}")
            return None
        try:
            values[key] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            values[key] = text
    return values
