"""Log in to a device that no inventory knows: its host key is confirmed by the operator, by fingerprint."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import typer

from meshctl.cli.extensions import attach_lab
from meshctl.device.connection import Credentials, Endpoint
from meshctl.device.errors import HostKeyChanged, HostKeyUnknown, IncompatibleServer
from meshctl.device.observation import Observation
from meshctl.device.observe import observe
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.trust import HostKey
from meshctl.errors import InputError
from meshctl.model import Release, Secret


class ExpectedKey:
    """Accepts the host key with this fingerprint, any with `yes`, and none otherwise."""

    def __init__(self, fingerprint: str, *, yes: bool) -> None:
        self.fingerprint = fingerprint
        self.yes = yes
        self.key: HostKey | None = None

    def known(self, endpoint: Endpoint) -> tuple[HostKey, ...]:
        return ()

    def check(self, endpoint: Endpoint, key: HostKey) -> None:
        self.key = key
        if self.fingerprint and key.fingerprint != self.fingerprint:
            raise HostKeyChanged(
                f"{endpoint.label}: has the host key {key.fingerprint} ({key.key_type}), expected {self.fingerprint}",
                fingerprint=key.fingerprint,
                key_type=key.key_type,
                pinned=(self.fingerprint,),
                hint="another device answers at this address, or the fingerprint is of another of its keys",
            )
        if not self.fingerprint and not self.yes:
            raise HostKeyUnknown(
                f"{endpoint.label}: has the host key {key.fingerprint} ({key.key_type})",
                fingerprint=key.fingerprint,
                key_type=key.key_type,
                hint=f"compare it with the one on the device, then add --fingerprint {key.fingerprint}",
            )


def read_device(
    place: str,
    *,
    key_files: tuple[Path, ...],
    lab: Path | None,
    fingerprint: str,
    yes: bool,
    password: Secret | None,
    paths: Iterable[str],
) -> tuple[Observation, str]:
    """Observe the device at `[USER@]HOST[:PORT]`, and its host key as `TYPE BASE64`.

    Asks on a terminal whether an unknown fingerprint is right. Raises HostKeyUnknown, HostKeyChanged and what
    `ssh.connect` raises.
    """
    endpoint = _endpoint(place, lab)
    # a factory device accepts root without a password
    credentials = Credentials(key_files=key_files, password=password, empty_password=password is None)
    policy = ExpectedKey(fingerprint, yes=yes)

    def open_connection() -> SshConnection:
        try:
            return connect(endpoint, credentials=credentials, trust=policy)
        except IncompatibleServer:
            # the release is not known yet: 19.07 offers RSA with SHA-1 alone
            return connect(endpoint, credentials=credentials, trust=policy, release=Release.V19_07)

    connection = _confirmed(open_connection, policy)
    try:
        observation = observe(connection, extra_paths=paths)
    finally:
        connection.close()
    assert policy.key is not None
    return observation, policy.key.text


def _confirmed(open_connection: Callable[[], SshConnection], policy: ExpectedKey) -> SshConnection:
    try:
        return open_connection()
    except HostKeyUnknown as unknown:
        if not sys.stdin.isatty():
            raise
        if not typer.confirm(f"{unknown}. Does this match the fingerprint on the device?", err=True):
            raise
        policy.fingerprint = unknown.fingerprint
    return open_connection()


def _endpoint(place: str, lab: Path | None) -> Endpoint:
    user, at, rest = place.rpartition("@")
    host, colon, port = rest.rpartition(":")
    if not colon or (rest.count(":") > 1 and not rest.startswith("[")):
        host, port = rest, "22"
    if not host or (at and not user) or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"{place}: expected [USER@]HOST or [USER@]HOST:PORT")
    endpoint = Endpoint(host.strip("[]"), int(port), user or "root")
    if lab is None:
        return endpoint
    fleet = attach_lab(lab)
    there = fleet.bench_endpoint(host) if host in fleet.node_names else fleet.endpoint(endpoint.host)
    return replace(endpoint, host=there.host, port=there.port)
