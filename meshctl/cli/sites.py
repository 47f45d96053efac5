"""`meshctl sites`: the workers at the sites of the inventory."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from meshctl import __version__
from meshctl.cli.context import AsJson, DryRun, InventoryPath, KeyFiles, Lab, Session, session
from meshctl.cli.key_pinning import pin_host_key
from meshctl.cli.output import echo, echo_json
from meshctl.cli.site_status import as_object, exit_code, query_sites, show
from meshctl.device.errors import AuthenticationRefused
from meshctl.device.trust import AcceptAnyKey, HostKey
from meshctl.device.upload import UploadProgress
from meshctl.errors import ExitCode, InputError, MeshctlError
from meshctl.inventory.edit import Editor, save
from meshctl.model import Site
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.site_gateways import PIN_PREFIX
from meshctl.sites.gateway import Gateway, WorkerRelease, build_release, download_wheels, install, probe
from meshctl.sites.nats_uplink import NatsUplink
from meshctl.sites.service import start_service, unit, unit_name
from meshctl.sites.ssh_uplink import SshUplink
from meshctl.suggest import did_you_mean
from meshctl.wording import join_limited

app = typer.Typer(no_args_is_help=True)

_PERCENT_EVERY_S = 5.0

SiteNames = Annotated[list[str] | None, typer.Argument(metavar="[SITES]...", help="Names of sites; default: all.")]


def selected_sites(opened: Session, names: Iterable[str] | None, *, with_login: bool = False) -> tuple[Site, ...]:
    """The named sites with a worker, or those whose gateway has a login; all without names. Raises InputError."""
    sites = opened.fleet.sites
    able = {name: site for name, site in sites.items() if (site.has_gateway if with_login else site.has_worker)}
    setting = "set sites.{}.ssh.host" if with_login else "set sites.{0}.ssh.host or sites.{0}.nats"
    if opened.lab is not None:
        setting = "in a lab, only gateways on this machine are used: unset MESHCTL_LAB, and omit --lab"
    wanted = list(names or ())
    for name in wanted:
        if name not in opened.fleet.sites:
            hint = did_you_mean(name, sites) or (f"its sites are {join_limited(list(sites))}" if sites else "")
            raise InputError(f"no site of {opened.fleet.name} is named {name!r}", hint=hint)
        if name not in able:
            raise InputError(f"site {name} has no gateway", hint=setting.format(name))
    if not able:
        raise InputError(f"no site of {opened.fleet.name} has a gateway", hint=setting.format("NAME"))
    return tuple(able[name] for name in dict.fromkeys(wanted or able))


@app.command("status")
def status_command(
    sites: SiteNames = None,
    inventory: InventoryPath = Path(),
    nodes: Annotated[bool, typer.Option("--nodes", help="Also let the workers query all their nodes.")] = False,
    as_json: AsJson = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Show each site's worker and its latest run; with --nodes also how many nodes are healthy, and the alarms.

    Exit code: 0 healthy, 1 degraded or a site does not answer, 3 no site answers, 2 could not run.

    Example: meshctl sites status --nodes
    """
    with session(inventory, key_files=key or (), lab=lab) as opened:
        found = query_sites(opened, inventory, selected_sites(opened, sites), with_nodes=nodes)
    if as_json:
        echo_json(json.dumps([as_object(each) for each in found], indent=1))
    else:
        show(found)
    raise typer.Exit(exit_code(found))


@app.command("install")
def install_command(
    sites: SiteNames = None,
    inventory: InventoryPath = Path(),
    wheels: Annotated[
        Path | None,
        typer.Option("--wheels", metavar="DIR", help="Directory with the required wheels; default: use pip's index."),
    ] = None,
    dry_run: DryRun = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Install or update meshctl on the gateways, generate a key on each, and write its public part into the inventory.

    The gateways need Python 3.11, but neither root nor internet access. Only the operators in the inventory may give
    orders.

    Example: meshctl sites install north --wheels wheels/
    """
    with session(inventory, key_files=key or (), lab=lab) as opened:
        if not opened.fleet.operators.ssh_keys:
            raise InputError("operators.ssh_keys is empty: no operator could sign an order", hint="add your public key")
        failed: list[MeshctlError] = []
        releases: dict[tuple[Gateway, str], WorkerRelease] = {}
        for site in selected_sites(opened, sites, with_login=True):
            try:
                public_key = _install(opened, site, wheels, releases, dry_run=dry_run)
            except MeshctlError as error:
                failed.append(error)
                echo(f"{site.name}: {error}" + (f"\n  hint: {error.hint}" if error.hint else ""), err=True)
                continue
            if public_key and public_key != site.worker_key:
                _write_key(inventory, site.name, public_key)
    if failed:
        raise typer.Exit(failed[0].exit_code)


def _install(
    opened: Session,
    site: Site,
    wheels: Path | None,
    releases: dict[tuple[Gateway, str], WorkerRelease],
    *,
    dry_run: bool,
) -> str:
    """Install on one gateway; returns the worker's public key, empty with `dry_run`. `releases` were made so far."""
    with opened.access.connect_gateway(site) as connection:
        gateway = probe(connection)
        echo(f"{site.name}: {gateway.target}")
        if dry_run:
            echo(f"{site.name}: meshctl {__version__} would be installed")
            return ""
        extra = "nats" if site.nats is not None else ""
        if (gateway, extra) not in releases:
            with tempfile.TemporaryDirectory() as scratch:
                directory = Path(scratch) if wheels is not None else _cache(f"{gateway.target} {extra}".strip())
                collected = download_wheels(gateway.target, directory, wheels, extra)
                releases[gateway, extra] = build_release(gateway, collected)
        release = releases[gateway, extra]
        echo(f"{site.name}: sending meshctl {__version__}, {len(release.archive) >> 20} MiB")
        install(connection, gateway, release, _Percent(site.name))
    with SshUplink(opened.fleet, site, opened.access) as uplink:
        public_key = uplink.install(opened.fleet.operators.ssh_keys)
    _start_permanent_worker(opened, site)
    echo(f"{site.name}: installed; its worker has the key {public_key}")
    return public_key


def _start_permanent_worker(opened: Session, site: Site) -> None:
    """Start or restart the worker of a site with `nats`, as a service of its gateway."""
    if site.nats is None or opened.fleet.nats is None:
        return
    name = unit_name(opened.fleet.name, site.name)
    text = unit(opened.fleet.name, site.name, site.nats, opened.fleet.nats)
    with opened.access.connect_gateway(site) as connection:
        left = start_service(connection, name, text)
    echo(f"{site.name}: {name} is running" if not left else f"{site.name}: {name} is written; {left}")


class _Percent:
    """A line every few seconds of an upload, for terminals and logs alike."""

    def __init__(self, site: str) -> None:
        self._site = site
        self._next_s = time.monotonic() + _PERCENT_EVERY_S

    def __call__(self, progress: UploadProgress) -> None:
        if time.monotonic() >= self._next_s and progress.total:
            self._next_s = time.monotonic() + _PERCENT_EVERY_S
            echo(f"{self._site}: {progress.verified * 100 // progress.total} % sent")


def _cache(target: str) -> Path:
    root = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    return Path(root) / "meshctl" / "gateway-wheels" / f"{__version__} {target}".replace(" ", "-")


def _write_key(inventory: Path, site: str, public_key: str) -> None:
    editor = Editor.open(inventory, environ=os.environ)
    editor.set(("sites", site, "worker_key"), public_key)
    changes = editor.changes()
    save(changes)
    for change in changes:
        echo(f"{site}: worker_key written to {change.file}")
    echo(f"{site}: provision its nodes once more without the worker, so that they accept the key:")
    echo(f"  meshctl provision site:{site} --direct")


@app.command("cancel")
def cancel_command(
    site: Annotated[str, typer.Argument(help="Name of the site.")],
    run: Annotated[str, typer.Argument(help="The run, as `meshctl sites status` shows it.")],
    inventory: InventoryPath = Path(),
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Delete an order that waits for a site over NATS, before the site fetches it.

    Exit code: 0 deleted, 1 no such order waits: the site may have fetched it.

    Example: meshctl sites cancel north 0123456789abcdef
    """
    with session(inventory, key_files=key or (), lab=lab) as opened:
        (selected,) = selected_sites(opened, [site])
        with NatsUplink(opened.fleet, selected, opened.access, must_answer=False) as uplink:
            if uplink.cancel(run):
                echo(f"{site}: the order of run {run} is deleted; nothing was changed")
                return
    echo(f"{site}: no order of run {run} waits: the site has fetched it, or it was never sent")
    raise typer.Exit(ExitCode.FINDINGS)


@app.command("trust")
def trust_command(
    sites: SiteNames = None,
    inventory: InventoryPath = Path(),
    change: Annotated[bool, typer.Option("--replace", help="Also accept changed keys.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Pin without confirmation.")] = False,
    dry_run: DryRun = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Show the gateways' host key fingerprints and pin them in the fleet's known_hosts after confirmation.

    Example: meshctl sites trust north
    """
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=dry_run) as opened:
        results = [
            _pin(opened, site, may_replace=change, yes=yes, dry_run=dry_run)
            for site in selected_sites(opened, sites, with_login=True)
        ]
    if not all(results):
        raise typer.Exit(ExitCode.FINDINGS)


def _pin(opened: Session, site: Site, *, may_replace: bool, yes: bool, dry_run: bool) -> bool:
    try:
        shown = _presented_key(opened, site)
    except MeshctlError as error:
        echo(f"{site.name}: {error}" + (f"\n  hint: {error.hint}" if error.hint else ""))
        return False
    name = f"{PIN_PREFIX}{site.name}"
    return pin_host_key(
        opened.trust,
        name,
        shown,
        label=site.name,
        device="gateway",
        may_replace=may_replace,
        yes=yes,
        dry_run=dry_run,
    )


def _presented_key(opened: Session, site: Site) -> HostKey:
    """The unverified host key of a gateway."""
    recorder = AcceptAnyKey()
    anonymous = ConnectionPool(opened.fleet, opened.trust, use_agent=False, deadlines=opened.access.deadlines)
    try:
        # without credentials: the key is presented before the login
        anonymous.connect_gateway(_without_keys(site), recorder).close()
    except AuthenticationRefused:
        if recorder.key is None:
            raise
    assert recorder.key is not None, "a completed handshake presents a key"
    return recorder.key


def _without_keys(site: Site) -> Site:
    return replace(site, ssh=replace(site.ssh, key_files=()))
