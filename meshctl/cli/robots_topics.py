"""`meshctl robots topic` and `rotate-key`: change the inventory and the running daemons together.

The edit is validated first (the inventory must load, every daemon must accept it), then saved, then deployed to the
robots, whose daemons reload without dropping a message. If no robot accepts it, the inventory edit is reverted.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import typer
import yaml

from meshctl.cli.context import DryRun
from meshctl.cli.journaled_run import JournaledRun
from meshctl.cli.output import echo
from meshctl.cli.robots_context import RobotsContext, finish, run_command, with_robots_context
from meshctl.cli.robots_dry_run import deploy_differences, exit_for_dry_run
from meshctl.errors import InputError
from meshctl.inventory.edit import Editor, FileEdit, add_topic, remove_topic, save, set_topic
from meshctl.inventory.yaml_text import Value
from meshctl.model import SecretRef
from meshctl.robots.key_rotation import RotationStage, inventory_value, parse_ref, rotation_stages

topic_app = typer.Typer(help="Change topics in the inventory and on all robots.", no_args_is_help=True)

Topic = Annotated[str, typer.Argument(help="Topic name.")]
Assignments = Annotated[
    list[str],
    typer.Argument(metavar="KEY=VALUE", help="Topic settings: priority=9 destinations=[base]"),
]


_SHARED = ("inventory", "wheels", "wait_s", "ask_sudo", "as_json", "key")


@topic_app.command("add")
@with_robots_context(*_SHARED)
def topic_add(context: RobotsContext, topic: Topic, values: Assignments, dry_run: DryRun = False) -> None:
    """Add a topic to the inventory and to every running daemon, without a restart.

    Example: meshctl robots topic add video priority=9 reliable=false 'destinations=[base-station]'
    """
    fields = _fields(values)
    _change_topics(context, topic, lambda editor: add_topic(editor, topic, fields), dry_run=dry_run)


@topic_app.command("set")
@with_robots_context(*_SHARED)
def topic_set(context: RobotsContext, topic: Topic, values: Assignments, dry_run: DryRun = False) -> None:
    """Change a topic in the inventory and in every running daemon, without a restart.

    Example: meshctl robots topic set video priority=12
    """
    fields = _fields(values)
    _change_topics(context, topic, lambda editor: set_topic(editor, topic, fields), dry_run=dry_run)


@topic_app.command("rm")
@with_robots_context(*_SHARED)
def topic_rm(context: RobotsContext, topic: Topic, dry_run: DryRun = False) -> None:
    """Remove a topic from the inventory and from every running daemon, without a restart.

    Example: meshctl robots topic rm video
    """
    _change_topics(context, topic, lambda editor: remove_topic(editor, topic), dry_run=dry_run)


def _fields(assignments: list[str]) -> dict[str, Value]:
    """Parse `priority=9 destinations=[base]`. Raises InputError."""
    fields: dict[str, Value] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name:
            raise InputError(f"expected KEY=VALUE, found {assignment!r}")
        try:
            value = yaml.safe_load(text)
        # ValueError: a date such as 2026-99-99; RecursionError: deep nesting
        except (yaml.YAMLError, ValueError, RecursionError):
            raise InputError(f"{name}: expected a YAML value, found {text!r}") from None
        if isinstance(value, list) and all(isinstance(item, str) for item in value):
            fields[name] = tuple(value)
        elif isinstance(value, str | int | float | bool):
            fields[name] = value
        else:
            raise InputError(f"{name}: expected a number, string, boolean or [list], found {text!r}")
    return fields


def _change_topics(context: RobotsContext, topic: str, edit: Callable[[Editor], None], *, dry_run: bool) -> None:
    changed, changes = _edited(context, edit)
    if not context.as_json:
        for change in changes:
            echo(change.diff(), nl=False)
    if dry_run:
        raise exit_for_dry_run(changed, deploy_differences(changed))
    journaled = _save_and_run(changed, changes, "topic", topic=topic)
    if not any(outcome.result.is_good for outcome in journaled.outcomes.values()):
        _undo(changes)
        echo("no robot accepted the change; the inventory edit was reverted", err=True)
    raise finish(changed, journaled)


def _edited(context: RobotsContext, edit: Callable[[Editor], None]) -> tuple[RobotsContext, tuple[FileEdit, ...]]:
    """The context for the edited inventory, and the changes to save.

    Raises InvalidInput and InputError if the edited inventory does not load, or a daemon would reject it.
    """
    editor = Editor.open(context.inventory, environ=os.environ)
    edit(editor)
    return context.with_fleet(editor.fleet(), only_configuration=True), editor.changes()


def _save_and_run(
    context: RobotsContext, changes: tuple[FileEdit, ...], command: str, **parameters: Any
) -> JournaledRun:
    """Save the edits, and run the command. If it is refused before its first robot, the edits are reverted."""
    begun: list[bool] = []
    save(changes)
    try:
        return run_command(context, command, lambda: begun.append(True), **parameters)
    except BaseException:
        if not begun:
            _undo(changes)
            echo("no robot was reached; the inventory edit was reverted", err=True)
        raise


def _undo(changes: tuple[FileEdit, ...]) -> None:
    save(tuple(FileEdit(change.file, change.after, change.before) for change in changes))


@with_robots_context(*_SHARED)
def rotate_key_command(
    context: RobotsContext,
    new_key: Annotated[
        str,
        typer.Argument(
            metavar="NEW_KEY",
            help="Reference to the new key: env:NAME, file:PATH or file:PATH#ENTRY, relative to the inventory.",
        ),
    ],
    dry_run: DryRun = False,
) -> None:
    """Rotate the fleet key without an interruption: accept the new key everywhere, use it, then drop the old one.

    Each step must reach every robot before the next starts. After an interruption, or with a robot unreachable, run the
    same command again to continue.

    Example: meshctl robots rotate-key file:secrets.yaml#udp_mesh_2027
    """
    todo = rotation_stages(context.fleet.udp_mesh.keys, parse_ref(new_key))
    if dry_run:
        raise _rotation_differences(context, todo)
    for number, stage in enumerate(todo, start=1):
        if not context.as_json:
            echo(f"step {number} of {len(todo)}: {stage.title}")
        context, changes = _edited(context, partial(_set_keys, keys=stage.keys))
        journaled = _save_and_run(context, changes, "rotate-key", new_key=new_key)
        late = ", ".join(name for name, outcome in journaled.outcomes.items() if not outcome.result.is_good)
        if late:
            echo(f"stopped before the next step: {late} did not complete this one; no robot is cut off", err=True)
            echo("hint: run the same command again once they are reachable", err=True)
        if late or number == len(todo):
            raise finish(context, journaled, retry=f"run `meshctl robots rotate-key {new_key}`")


def _rotation_differences(context: RobotsContext, todo: tuple[RotationStage, ...]) -> typer.Exit:
    """Print the steps, and what the first one would change; returns the exit to raise."""
    changed, changes = _edited(context, partial(_set_keys, keys=todo[0].keys))
    if not context.as_json:
        for number, stage in enumerate(todo, start=1):
            echo(f"step {number} of {len(todo)}: {stage.title}")
        echo("the first step would change:")
        for change in changes:
            echo(change.diff(), nl=False)
    return exit_for_dry_run(changed, deploy_differences(changed))


def _set_keys(editor: Editor, keys: tuple[SecretRef, ...]) -> None:
    editor.set(("udp_mesh", "keys"), [inventory_value(key) for key in keys])
