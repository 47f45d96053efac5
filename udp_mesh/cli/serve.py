"""`run`, `check` and `keygen`: the commands that need no running daemon.

Each imports what it needs of the transport itself: the other commands start in a third of the time without it.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from udp_mesh.cli.output import Exit, counted, print_error, print_json, print_text
from udp_mesh.daemon.interface import RESERVED_PREFIX

if TYPE_CHECKING:
    from udp_mesh.daemon.toml_source import ConfigurationError


def run_daemon(arguments: argparse.Namespace) -> int:
    """Runs the daemon until it is stopped."""
    import asyncio
    import logging

    from udp_mesh.daemon.configuration import load
    from udp_mesh.daemon.main import run
    from udp_mesh.daemon.toml_source import ConfigurationError

    logging.basicConfig(level=arguments.log_level.upper(), format="%(levelname)s %(message)s")
    try:
        configuration = load(arguments.config)
    except ConfigurationError as error:
        return _print_problems(error)
    try:
        asyncio.run(run(configuration))
    except OSError as error:
        print_error(f"cannot start: {_reason(error)}")
        return Exit.FAILED
    return Exit.OK


def _reason(error: OSError) -> str:
    """The error without its number, with a hint if a path is not accessible."""
    if error.strerror is None:
        return str(error)
    place = f"{error.filename}: " if error.filename is not None else ""
    hint = " (run as root, or change `socket` and `state_directory` in [daemon])"
    return f"{place}{error.strerror}{hint if isinstance(error, PermissionError) else ''}"


def check(arguments: argparse.Namespace) -> int:
    """Checks a configuration and prints its problems, or a summary."""
    from udp_mesh.daemon.configuration import load
    from udp_mesh.daemon.status import plain
    from udp_mesh.daemon.toml_source import ConfigurationError

    try:
        configuration = load(arguments.config)
    except ConfigurationError as error:
        if arguments.json:
            print_json({"ok": False, "problems": [plain(problem) for problem in error.problems]})
            return Exit.CONFIGURATION
        return _print_problems(error)
    settings = configuration.settings
    topics = [topic for topic in settings.topics if not topic.name.startswith(RESERVED_PREFIX)]
    if arguments.json:
        print_json(
            {
                "ok": True,
                "name": settings.name,
                "port": settings.port,
                "keys": [key.key_id.hex() for key in settings.keys],
                "unkeyed": settings.unkeyed,
                "topics": [plain(topic) for topic in topics],
                "window": settings.window,
                "fragment_bytes": settings.fragment_bytes,
                "undeclared": plain(settings.undeclared),
                "neighbours": plain(settings.neighbours),
                "links": plain(configuration.links),
                "rates": plain(settings.rates),
                "limits": plain(settings.limits),
                "daemon": plain(configuration.daemon),
            }
        )
    else:
        protection = "UNKEYED" if settings.unkeyed else counted(len(settings.keys), "key")
        topic_count = counted(len(topics), "topic")
        print_text(f"{arguments.config}: valid: {settings.name}, port {settings.port}, {topic_count}, {protection}")
    return Exit.OK


def _print_problems(error: ConfigurationError) -> int:
    for problem in error.problems:
        print_error(str(problem))
    return Exit.CONFIGURATION


def keygen(arguments: argparse.Namespace) -> int:
    """Creates a fleet key, readable only by its owner; never overwrites a file."""
    from udp_mesh.crypto import Key
    from udp_mesh.crypto.keys import SECRET_BYTES

    key = Key(os.urandom(SECRET_BYTES))
    line = f"{key.secret.hex()}  # {key.key_id.hex()}\n"
    path: Path = arguments.file
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        print_error(
            f"{path}: exists, and is not overwritten: choose another file, or delete it if no robot uses this key"
        )
        return Exit.FAILED
    except OSError as error:
        print_error(f"{path}: {error.strerror}")
        return Exit.FAILED
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(line)
    except OSError as error:
        # an empty file would be refused by every daemon, and by the next keygen
        path.unlink(missing_ok=True)
        print_error(f"{path}: {error.strerror}")
        return Exit.FAILED
    print_text(f"{path}: key {key.key_id.hex()}")
    return Exit.OK
