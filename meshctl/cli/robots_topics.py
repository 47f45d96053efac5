"""`meshctl robots topic` and `rotate-key`: the inventory and the running daemons changed together.

The edit is checked as a whole first (it must load, and every daemon must take it), then written, then brought to the
robots, whose daemons read their files again without dropping a message. Where no robot took it, the inventory goes
back.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Annotated

import typer
import yaml

from meshctl.cli.output import echo
from meshctl.cli.robots_context import RobotsContext, print_totals, run_command, with_robots_context
from meshctl.errors import InputError
from meshctl.fleet import Outcome, totals
from meshctl.inventory import load_fleet
from meshctl.inventory.edit import Change, Editor, add_topic, remove_topic, save, set_topic
from meshctl.inventory.yaml_text import Value
from meshctl.model import SecretRef
from meshctl.robots.key_rotation import inventory_value, parse_ref, rotation_stages

topic_app = typer.Typer(help="Topics: in the inventory and on all robots at once.", no_args_is_help=True)

Topic = Annotated[str, typer.Argument(help="The topic's name.")]
Assignments = Annotated[
    list[str], typer.Argument(metavar="KEY=VALUE...", help="As in the inventory: priority=9 destinations=[base]")
]


_SHARED = ("inventory", "wheels", "wait_s", "ask_sudo", "as_json", "key")


@topic_app.command("add")
@with_robots_context(*_SHARED)
def topic_add(context: RobotsContext, topic: Topic, values: Assignments) -> None:
    """Add a topic to the inventory and to every running daemon, without a restart.

    Example: meshctl robots topic add video priority=9 reliable=false destinations=[base-station]
    """
    fields = _fields(values)
    _change_topics(context, topic, lambda editor: add_topic(editor, topic, fields))


@topic_app.command("set")
@with_robots_context(*_SHARED)
def topic_set(context: RobotsContext, topic: Topic, values: Assignments) -> None:
    """Change a topic in the inventory and in every running daemon, without a restart.

    Example: meshctl robots topic set video priority=12
    """
    fields = _fields(values)
    _change_topics(context, topic, lambda editor: set_topic(editor, topic, fields))


@topic_app.command("rm")
@with_robots_context(*_SHARED)
def topic_rm(context: RobotsContext, topic: Topic) -> None:
    """Take a topic out of the inventory and out of every running daemon, without a restart.

    Example: meshctl robots topic rm video
    """
    _change_topics(context, topic, lambda editor: remove_topic(editor, topic))


def _fields(assignments: list[str]) -> dict[str, Value]:
    """`priority=9 destinations=[base]` as values of the inventory. Raises InputError."""
    fields: dict[str, Value] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name:
            raise InputError(f"expected KEY=VALUE, found {assignment!r}")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            raise InputError(f"{name}: expected a value as in the inventory, found {text!r}") from None
        if isinstance(value, list) and all(isinstance(item, str) for item in value):
            fields[name] = tuple(value)
        elif isinstance(value, str | int | float | bool):
            fields[name] = value
        else:
            raise InputError(f"{name}: expected a number, a text, true, false or [a, list], found {text!r}")
    return fields


def _change_topics(context: RobotsContext, topic: str, edit: Callable[[Editor], None]) -> None:
    changed, changes = _edited(context, edit)
    if not context.as_json:
        for change in changes:
            echo(change.diff(), nl=False)
    outcomes = run_command(changed, "topic", topic=topic)
    if not any(outcome.result.is_good for outcome in outcomes.values()):
        _undo(changes)
        echo("no robot took the change, so the inventory is as it was", err=True)
    raise print_totals(changed, outcomes)


def _edited(context: RobotsContext, edit: Callable[[Editor], None]) -> tuple[RobotsContext, tuple[Change, ...]]:
    """The inventory edited, checked and saved, and the context under it."""
    editor = Editor.open(context.inventory, environ=os.environ)
    edit(editor)
    changes = editor.changes()
    save(changes)
    try:
        return context.with_fleet(load_fleet(context.inventory, environ=os.environ), only_configuration=True), changes
    except InputError:
        # what loads, but no daemon would take
        _undo(changes)
        raise


def _undo(changes: tuple[Change, ...]) -> None:
    save(tuple(Change(change.file, change.after, change.before) for change in changes))


@with_robots_context(*_SHARED)
def rotate_key_command(
    context: RobotsContext,
    new_key: Annotated[
        str,
        typer.Argument(
            metavar="NEW_KEY",
            help="Where the new key is: env:NAME, file:PATH or file:PATH#ENTRY (relative to the inventory).",
        ),
    ],
) -> None:
    """Give the fleet a new key without an interruption: accepted everywhere, then used, then the old one dropped.

    Each step must reach every robot before the next begins. Interrupted, or with a robot away, run the same command
    again: it goes on where it was.

    Example: meshctl robots rotate-key file:secrets.yaml#udp_mesh_2027
    """
    todo = rotation_stages(context.fleet.udp_mesh.keys, parse_ref(new_key))
    outcomes: dict[str, Outcome] = {}
    for number, stage in enumerate(todo, start=1):
        if not context.as_json:
            echo(f"step {number} of {len(todo)}: {stage.title}")
        context, _ = _edited(context, partial(_set_keys, keys=stage.keys))
        outcomes = run_command(context, "rotate-key", new_key=new_key)
        if not totals(outcomes.values()).all_good:
            late = ", ".join(name for name, outcome in outcomes.items() if not outcome.result.is_good)
            echo(f"stopped before the next step, nothing is cut off: {late} did not take this one", err=True)
            echo("run the same command again once they can be reached", err=True)
            break
    raise print_totals(context, outcomes)


def _set_keys(editor: Editor, keys: tuple[SecretRef, ...]) -> None:
    editor.set(("udp_mesh", "keys"), [inventory_value(key) for key in keys])
