"""Options that several commands share with what they open: written once, for the command line and for who opens it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any, get_type_hints

Options = Mapping[str, tuple[Any, Any]]
"""By the opener's name for it: an option's type and default, as typer reads them of a function, in the help's order."""


def opening(
    parameter: str, opener: Callable[..., AbstractContextManager[Any]], options: Options
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A command that takes `parameter` and options of its own becomes one that has these `options` besides: `opener` is
    called with them, and what it opens stands for as long as the command runs."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(command, include_extras=True)
        keyword = inspect.Parameter.KEYWORD_ONLY
        own = [
            each.replace(annotation=hints[each.name], kind=keyword)
            for each in inspect.signature(command).parameters.values()
            if each.name != parameter
        ]
        shared = [
            inspect.Parameter(name, keyword, default=default, annotation=kind)
            for name, (kind, default) in options.items()
        ]

        def run_command(**given: Any) -> None:
            with opener(**{name: given.pop(name) for name in options}) as opened:
                command(opened, **given)

        parameters = [*own, *shared]
        run_command.__name__, run_command.__doc__ = command.__name__, command.__doc__
        # what typer reads of a function
        run_command.__annotations__ = {each.name: each.annotation for each in parameters}
        vars(run_command)["__signature__"] = inspect.Signature(parameters)
        return run_command

    return decorate
