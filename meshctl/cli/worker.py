"""`meshctl worker`: what `meshctl` starts on a site's gateway. Not for typing."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from meshctl.cli.output import ignore_broken_pipe
from meshctl.errors import InputError


def worker(
    site: Annotated[str, typer.Argument(metavar="FLEET/SITE", help="The site that this gateway serves.")],
    stdio: Annotated[
        bool, typer.Option("--stdio", help="Answer an operator's requests on standard input and output.")
    ] = False,
    nats: Annotated[str, typer.Option("--nats", metavar="URL", help="Serve permanently at this NATS leaf node.")] = "",
    hub: Annotated[str, typer.Option("--hub", metavar="DOMAIN", help="JetStream domain of the hub.")] = "hub",
    execute: Annotated[str, typer.Option("--execute", metavar="RUN", help="Execute an ordered run to its end.")] = "",
) -> None:
    """Serve a site: plan and execute changes of its nodes for operators, who connect over SSH or NATS.

    `meshctl sites install` puts it on the gateway: over NATS as a systemd unit, over SSH started by each command.

    Example: meshctl worker mines/north --stdio

    Example: meshctl worker mines/north --nats nats://127.0.0.1:4222
    """
    from meshctl.sites import worker as serving

    if sum((stdio, bool(execute), bool(nats))) != 1:
        raise InputError("expected --stdio, --nats URL or --execute RUN", hint="`meshctl provision` starts it")
    if nats:
        _serve_nats(site, nats, hub)
        return
    if execute:
        raise typer.Exit(serving.execute(site, execute, os.environ))
    # a lost uplink leaves a reply that no one reads
    with ignore_broken_pipe():
        serving.serve(site, os.environ, sys.stdin.buffer, sys.stdout.buffer)


def _serve_nats(site: str, url: str, hub: str) -> None:
    from meshctl.sites.nats_client import NatsClient, NatsServer
    from meshctl.sites.nats_worker import Complaint, NatsWorker
    from meshctl.sites.runs import SiteDirectory

    directory = SiteDirectory.of(site, os.environ)
    server = NatsServer(url, name=f"meshctl worker {site}")
    complaint = Complaint(f"waiting for the leaf node {url}: ", "connected to the leaf node")
    NatsWorker(directory, os.environ, NatsClient(server, note=complaint), hub).serve()
