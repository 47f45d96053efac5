"""`meshctl worker`: what `meshctl` starts on a site's gateway. Not for typing."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from meshctl.errors import InputError


def worker(
    site: Annotated[str, typer.Argument(metavar="FLEET/SITE", help="The site that this gateway serves.")],
    stdio: Annotated[
        bool, typer.Option("--stdio", help="Answer an operator's requests on standard input and output.")
    ] = False,
    execute: Annotated[
        str, typer.Option("--execute", metavar="RUN", help="Execute a run that was ordered, to its end.")
    ] = "",
) -> None:
    """Serve a site: plan and execute changes of its nodes for operators, who connect over SSH.

    `meshctl sites install` puts it on the gateway, and `meshctl provision` starts it there.

    Example: meshctl worker mines/north --stdio
    """
    from meshctl.sites import worker as serving

    if stdio == bool(execute):
        raise InputError("expected either --stdio or --execute RUN", hint="`meshctl provision` starts it")
    if execute:
        raise typer.Exit(serving.execute(site, execute, os.environ))
    serving.serve(site, os.environ, sys.stdin.buffer, sys.stdout.buffer)
