"""Options of every command: `--verbose` shows events on standard error, `--log-file` appends them to a file."""

from __future__ import annotations

import inspect
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from meshctl import event_log
from meshctl.errors import ExitCode, InputError, MeshctlError

Verbose = Annotated[
    int,
    typer.Option(
        "--verbose",
        "-v",
        count=True,
        show_default=False,
        help="Show connections on standard error; -vv also every command on a device, with its exit status.",
    ),
]
LogFile = Annotated[
    Path | None,
    typer.Option(
        "--log-file",
        envvar="MESHCTL_LOG_FILE",
        help="Append all events to this file, as JSON lines with secrets masked.",
    ),
]


def with_verbosity(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add both options to a command."""
    hints = get_type_hints(command, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    own = [
        each.replace(annotation=hints.get(each.name, each.annotation), kind=keyword)
        for each in inspect.signature(command).parameters.values()
    ]
    added = [
        inspect.Parameter("verbose", keyword, default=0, annotation=Verbose),
        inspect.Parameter("log_file", keyword, default=None, annotation=LogFile),
    ]

    @wraps(command)
    def run(verbose: int = 0, log_file: Path | None = None, **given: Any) -> Any:
        with _recording(verbose, log_file):
            return command(**given)

    vars(run)["__signature__"] = inspect.Signature([*own, *added])
    run.__annotations__ = {each.name: each.annotation for each in (*own, *added)}
    return run


@contextmanager
def _recording(verbose: int, log_file: Path | None) -> Iterator[None]:
    """Show and write events within the block, and write how the command ended."""
    with ExitStack() as stack:
        if verbose:
            level = event_log.INFO if verbose == 1 else event_log.DEBUG
            handler = event_log.add_handler(sys.stderr, level, event_log.Lines())
            stack.callback(event_log.remove_handler, handler)
        if log_file is not None:
            stream = stack.enter_context(_opened(log_file))
            handler = event_log.add_handler(stream, event_log.DEBUG, event_log.JsonLines())
            stack.callback(event_log.remove_handler, handler)
        began = time.monotonic()
        words = sys.argv[1:]
        # words after `--` are for a device: the event of their execution has them, with secrets masked
        own = words[: words.index("--")] if "--" in words else words
        event_log.emit(event_log.INFO, "began", arguments=" ".join(own))
        code, error = int(ExitCode.OK), None
        try:
            yield
        except typer.Exit as ended:
            code = ended.exit_code
            raise
        except MeshctlError as failure:
            code, error = int(failure.exit_code), str(failure)
            raise
        except (KeyboardInterrupt, typer.Abort):
            code = int(ExitCode.INTERRUPTED)
            raise
        except BaseException as failure:
            code, error = -1, repr(failure)
            raise
        finally:
            took_s = round(time.monotonic() - began, 3)
            event_log.emit(event_log.INFO, "ended", exit_code=code, duration_s=took_s, error=error)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    path = path.expanduser()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    except OSError as error:
        raise InputError(f"cannot write the log file {path}: {error.strerror}") from error
    with open(descriptor, "a", encoding="utf-8") as stream:
        yield stream
