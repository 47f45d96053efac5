"""SSH to one node: socket or tunnel -> key exchange -> host key check -> login -> `SshConnection` -> `run`.

`connect` does these steps, each with its own deadline. Some waits of paramiko have no timeout (the answer to `exec`, a
full TCP buffer), so every wait here runs under a `Watchdog`. It closes the transport on timeout or silence, which ends
all of paramiko's waits; the connection cannot be used again.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from types import TracebackType

import paramiko

from meshctl import event_log
from meshctl.device.authentication import LoginAttempt, login_attempts
from meshctl.device.connection import Completed, Connection, Credentials, Deadlines, Endpoint
from meshctl.device.errors import (
    AUTHENTICATION,
    HANDSHAKE,
    AuthenticationRefused,
    ChannelClosed,
    ConnectionLost,
    IncompatibleServer,
    Timeout,
    Unreachable,
)
from meshctl.device.framing import framed, quoted
from meshctl.device.kept_script import KeptScript
from meshctl.device.legacy_rsa import SSH_RSA, LegacyTransport
from meshctl.device.liveness import ActivityStream, Watchdog, keepalives
from meshctl.device.sockets import open_socket
from meshctl.device.ssh_channel import collect, ignoring_closed, open_session, sending_stdin
from meshctl.device.ssh_stream import LineStream
from meshctl.device.traffic import TrafficMeter
from meshctl.device.trust import HostKey, HostKeyPolicy
from meshctl.errors import MeshctlError
from meshctl.model import Release

__all__ = ["SshConnection", "connect"]

# OpenWrt's dropbear closes the connection after three refusals (MaxAuthTries in /etc/init.d/dropbear).
MAX_LOGINS_PER_CONNECTION = 3
# Keepalives, which the reading thread sends when it wakes, may be late by this much.
MAX_POLL_S = 1.0
# Preferred for speed: X25519 alone is less work and fewer bytes than with ML-KEM beside it, and far less than a finite
# field. Every dropbear from OpenWrt 19.07 to 25.12 offers it.
FAST_KEX = ("curve25519-sha256@libssh.org",)
_RSA_SHA2 = ("rsa-sha2-512", "rsa-sha2-256")

# Without a handler, paramiko's logger would print every failed connection on stderr, beside our errors.
logging.getLogger("paramiko").addHandler(logging.NullHandler())


def connect(
    endpoint: Endpoint,
    *,
    credentials: Credentials,
    trust: HostKeyPolicy,
    deadlines: Deadlines | None = None,
    via: SshConnection | None = None,
    release: Release | None = None,
    legacy_rsa_sha1: bool = False,
    meter: TrafficMeter | None = None,
) -> SshConnection:
    """An authenticated connection to `endpoint`, through the node of `via` if given.

    `legacy_rsa_sha1` offers RSA with SHA-1 from the start; otherwise it is used only if the server offers nothing
    else and the node's `release` is 19.07. `meter` counts its bytes. Raises Unreachable, Timeout, ConnectionLost,
    IncompatibleServer, HostKeyUnknown, HostKeyChanged, AuthenticationRefused, and InputError for an unusable key file.
    """
    limits = deadlines or Deadlines()
    legacy = legacy_rsa_sha1
    with login_attempts(credentials, legacy_rsa_sha1=legacy or release is Release.V19_07) as attempts:
        remaining = list(attempts)
        tried: list[str] = []
        allowed: tuple[str, ...] = ()
        while True:
            try:
                transport, activity = _handshake(endpoint, limits, trust, via, meter, legacy=legacy)
            except _OnlySha1 as error:
                if legacy or release is not Release.V19_07:
                    raise IncompatibleServer(
                        f"{endpoint.label}: offers only an RSA host key with SHA-1",
                        hint="only OpenWrt 19.07 does; set the node's release, or upgrade it by cable",
                    ) from error
                legacy = True
                continue
            try:
                accepted, refused = _login(endpoint, transport, remaining[:MAX_LOGINS_PER_CONNECTION], limits)
            except BaseException:
                transport.close()
                raise
            if accepted:
                server = transport.remote_version
                event_log.emit(event_log.INFO, "connected", device=endpoint.label, server=server)
                return SshConnection(endpoint, transport, limits, activity)
            transport.close()
            tried += [attempt.name for attempt in remaining[:MAX_LOGINS_PER_CONNECTION]]
            allowed = refused or allowed
            remaining = remaining[MAX_LOGINS_PER_CONNECTION:]
            if not remaining:
                given = ", ".join(tried) or "no credentials"
                raise AuthenticationRefused(
                    f"{endpoint.label}: login refused for {endpoint.user}; tried: {given}",
                    tried=tuple(tried),
                    allowed=allowed,
                    hint="name a key (--key, ssh.key_files) whose public part is in its /etc/dropbear/authorized_keys",
                )


class _OnlySha1(Exception):
    """No host key algorithm in common, as with the dropbear of 19.07."""


@contextmanager
def _translating_errors(
    endpoint: Endpoint,
    transport: paramiko.Transport,
    seconds: float,
    phase: str,
    *,
    activity: ActivityStream | None = None,
    silence_s: float = 0.0,
) -> Iterator[None]:
    """Translate exceptions of paramiko and the OS into ours; a timeout takes precedence over what paramiko raises.

    With `activity`, a connection that is silent for `silence_s` is lost.
    """
    with Watchdog(transport, seconds, activity=activity, silence_s=silence_s) as watchdog:
        try:
            yield
        except (paramiko.SSHException, OSError, EOFError) as error:
            if watchdog.timed_out or watchdog.silent:
                raise _timeout_error(endpoint, watchdog, seconds, silence_s, phase) from error
            if transport.is_active():
                raise ChannelClosed(f"{endpoint.label}: {phase} was refused or cut: {error}") from error
            raise ConnectionLost(f"{endpoint.label}: the connection broke during {phase}: {error}") from error
    if watchdog.timed_out or watchdog.silent:
        raise _timeout_error(endpoint, watchdog, seconds, silence_s, phase)


def _timeout_error(endpoint: Endpoint, watchdog: Watchdog, seconds: float, silence_s: float, phase: str) -> Unreachable:
    if watchdog.timed_out:
        return Timeout(f"{endpoint.label}: no answer to {phase} within {seconds:g} s", phase=phase)
    return ConnectionLost(f"{endpoint.label}: silent for {silence_s:g} s during {phase}")


def _handshake(
    endpoint: Endpoint,
    limits: Deadlines,
    trust: HostKeyPolicy,
    via: SshConnection | None,
    meter: TrafficMeter | None,
    *,
    legacy: bool,
) -> tuple[paramiko.Transport, ActivityStream]:
    known = trust.known(endpoint)
    stream = open_socket(endpoint, limits) if via is None else via.tunnel(endpoint)
    count = partial((meter or TrafficMeter()).add, endpoint.identity)
    activity = ActivityStream(stream, poll_s=min(MAX_POLL_S, limits.ask_s / 2), count=count)
    transport = (LegacyTransport if legacy else paramiko.Transport)(activity)  # type: ignore[arg-type]
    transport.daemon = True
    transport.banner_timeout = transport.handshake_timeout = limits.handshake_s * 2  # ours comes first
    transport.auth_timeout = limits.auth_s * 2
    transport.clear_to_send_timeout = limits.run_s
    _prefer(transport, known, legacy=legacy)
    try:
        with _translating_errors(endpoint, transport, limits.handshake_s, HANDSHAKE):
            try:
                transport.start_client(timeout=limits.handshake_s * 2)
            except paramiko.ssh_exception.IncompatiblePeer as error:
                if "host key" in str(error):
                    raise _OnlySha1(str(error)) from error
                raise IncompatibleServer(f"{endpoint.label}: {error}") from error
            except paramiko.SSHException as error:
                if any(word in str(error) for word in ("protocol version", "SSH banner", "codec can't decode")):
                    raise IncompatibleServer(f"{endpoint.label}: not an SSH server") from error
                raise
        remote = transport.get_remote_server_key()
        trust.check(endpoint, HostKey(remote.get_name(), remote.asbytes()))
    except BaseException:
        transport.close()
        raise
    transport.set_keepalive(limits.keepalive_s)
    return transport, activity


def _prefer(transport: paramiko.Transport, known: tuple[HostKey, ...], *, legacy: bool) -> None:
    """Prefer the host key types that are pinned; the others stay offered, so that a changed key is detected."""
    rsa = (*_RSA_SHA2, SSH_RSA) if legacy else _RSA_SHA2
    pinned = [name for key in known for name in (rsa if key.key_type == SSH_RSA else (key.key_type,))]
    options = transport.get_security_options()
    options.kex = (*(name for name in FAST_KEX if name in options.kex), *(n for n in options.kex if n not in FAST_KEX))
    usual = tuple(options.key_types)
    options.key_types = (
        *(name for name in dict.fromkeys(pinned) if name in usual),
        *(n for n in usual if n not in pinned),
    )


def _login(
    endpoint: Endpoint, transport: paramiko.Transport, attempts: list[LoginAttempt], limits: Deadlines
) -> tuple[bool, tuple[str, ...]]:
    """Whether one of `attempts` was accepted, and otherwise the methods the server offers."""
    allowed: tuple[str, ...] = ()
    for attempt in attempts:
        with _translating_errors(endpoint, transport, limits.auth_s, AUTHENTICATION):
            try:
                attempt.run(transport, endpoint.user)
            except paramiko.BadAuthenticationType as error:
                allowed = tuple(error.allowed_types)
            except paramiko.AuthenticationException:
                if not transport.is_active():
                    # dropbear closes the connection after the last refusal it allows
                    return False, allowed
            except (paramiko.SSHException, EOFError):
                if not transport.is_active() and attempt is attempts[-1]:
                    return False, allowed
                raise
            if transport.is_authenticated():
                return True, ()
    return False, allowed


class SshConnection(Connection):
    """See `Connection`. Also opens tunnels to nodes behind this one."""

    def __init__(
        self, endpoint: Endpoint, transport: paramiko.Transport, limits: Deadlines, activity: ActivityStream
    ) -> None:
        self._endpoint = endpoint
        self._transport = transport
        self._limits = limits
        self._activity = activity
        self._kept: dict[str, KeptScript] = {}

    @property
    def endpoint(self) -> Endpoint:
        return self._endpoint

    @property
    def is_open(self) -> bool:
        return self._transport.is_active()

    @property
    def silent_s(self) -> float:
        """How long ago the server's last data arrived."""
        return time.monotonic() - self._activity.last_received_s

    @property
    def host_key(self) -> HostKey:
        key = self._transport.get_remote_server_key()
        return HostKey(key.get_name(), key.asbytes())

    def tunnel(self, target: Endpoint) -> paramiko.Channel:
        """A TCP stream from this node to `target` (direct-tcpip, RFC 4254 section 7.2)."""
        with _translating_errors(
            target, self._transport, self._limits.connect_s, f"a tunnel through {self._endpoint.label}"
        ):
            try:
                return self._transport.open_channel("direct-tcpip", (target.host, target.port), ("127.0.0.1", 0))
            except paramiko.ChannelException as error:
                raise Unreachable(f"{target.label}: {self._endpoint.label} cannot reach it: {error.text}") from error

    def run(self, script: str, *, stdin: bytes | Iterable[bytes] = b"", timeout_s: float | None = None) -> Completed:
        return self._recorded(script, partial(self._run, script, stdin, timeout_s))

    def run_kept(self, script: str, arguments: Sequence[str], *, timeout_s: float | None = None) -> Completed:
        return self._recorded(quoted("run", *arguments), partial(self._run_kept, script, arguments, timeout_s))

    def _recorded(self, script: str, run: Callable[[], Completed]) -> Completed:
        began = time.monotonic()
        try:
            done = run()
        except MeshctlError as error:
            self._record(script, began, error=str(error))
            raise
        size = len(done.stdout_bytes) + len(done.stderr_bytes)
        self._record(script, began, exit_status=done.exit_status, output_bytes=size)
        return done

    def _record(self, script: str, began: float, **fields: str | int) -> None:
        took_s = round(time.monotonic() - began, 3)
        label = self._endpoint.label
        event_log.emit(event_log.DEBUG, "command", device=label, **fields, duration_s=took_s, script=script)

    def _run(self, script: str, stdin: bytes | Iterable[bytes], timeout_s: float | None) -> Completed:
        sent = framed(script)
        seconds = self._limits.run_s if timeout_s is None else timeout_s
        pieces = (stdin,) if isinstance(stdin, bytes) else stdin
        with keepalives(self._transport, self._limits.ask_s, self._limits.keepalive_s):
            with self._waiting(min(seconds, self._limits.channel_s), "opening a channel"):
                channel = open_session(self._transport)
            try:
                with self._waiting(seconds, "a command"):
                    channel.exec_command(sent.command)
                    with sending_stdin(channel, sent.preamble, pieces, inline=isinstance(stdin, bytes)) as feeder:
                        out, err = collect(channel, self._endpoint.label)
                    status = channel.recv_exit_status()
                    if status < 0:
                        raise EOFError("no exit status: it was killed, or the link was cut")
                if feeder is not None and feeder.failure is not None:
                    raise feeder.failure
            finally:
                with ignoring_closed():
                    channel.close()
        return Completed(out, err, status)

    def _run_kept(self, script: str, arguments: Sequence[str], timeout_s: float | None) -> Completed:
        seconds = self._limits.run_s if timeout_s is None else timeout_s
        kept = self._kept.pop(script, None)
        with keepalives(self._transport, self._limits.ask_s, self._limits.keepalive_s):
            if kept is None or not kept.is_open:
                with self._waiting(min(seconds, self._limits.channel_s), "opening a channel"):
                    kept = KeptScript.start(self._transport, self._endpoint.label, script)
            try:
                with self._waiting(seconds, "a command"):
                    done = kept.run(arguments)
            except BaseException:
                with ignoring_closed():
                    kept.close()
                raise
        self._kept[script] = kept
        return done

    def stream(self, command: str) -> LineStream:
        """Start a command that exchanges lines with us until either side ends it. Raises Timeout, ConnectionLost."""
        with self._waiting(self._limits.channel_s, "opening a channel"):
            channel = open_session(self._transport)
            channel.exec_command(command)
        return LineStream(channel, self._endpoint.label)

    def _waiting(self, seconds: float, phase: str) -> AbstractContextManager[None]:
        silence_s = self._limits.silence_s
        return _translating_errors(
            self._endpoint, self._transport, seconds, phase, activity=self._activity, silence_s=silence_s
        )

    def close(self) -> None:
        self._transport.close()
        # wait for the thread that closes the socket: a caller may open hundreds
        self._transport.join(timeout=2.0)

    def __enter__(self) -> SshConnection:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
