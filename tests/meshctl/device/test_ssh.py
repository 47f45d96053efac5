"""SSH against real servers: dropbear with busybox ash behind it, OpenSSH for what only old releases do, and liars."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import paramiko
import pytest

from meshctl.device.connection import Credentials, Deadlines, Endpoint
from meshctl.device.errors import (
    AuthenticationRefused,
    ChannelClosed,
    ConnectionLost,
    HostKeyChanged,
    HostKeyUnknown,
    IncompatibleServer,
    OutputTooLarge,
    Timeout,
    Unreachable,
)
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.trust import TrustStore, parse_key
from meshctl.errors import InputError
from meshctl.model import Release, Secret
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import (
    PATIENT,
    Server,
    authorize,
    dropbear,
    eventually,
    free_port,
    give_dropbear,
    host_key,
    keypair,
    new_host_key,
    openssh,
    public,
)


@pytest.fixture
def key(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Our key: the one the server lets in, where the test has a server."""
    if "server" in request.fixturenames:
        request.getfixturevalue("server")
        return tmp_path / "operator"
    return keypair(tmp_path / "operator")


@pytest.fixture
def trust(tmp_path: Path, node: Sandbox, request: pytest.FixtureRequest) -> TrustStore:
    """Our pins: the server's key is among them, where the test has a server."""
    store = TrustStore(tmp_path / "known_hosts")
    if "server" in request.fixturenames:
        request.getfixturevalue("server")
        store.add("b03", host_key(node))
    return store


def only(*keys: Path) -> Credentials:
    return Credentials(key_files=keys, use_agent=False)


def login(endpoint: Endpoint, trust: TrustStore, key: Path, *, via: SshConnection | None = None) -> SshConnection:
    return connect(endpoint, credentials=only(key), trust=trust, via=via, deadlines=PATIENT)


def test_a_command_gives_its_output_its_errors_and_its_status(connection: SshConnection) -> None:
    done = connection.run("echo said; echo complained >&2; exit 3")
    assert (done.stdout, done.stderr, done.exit_status) == ("said\n", "complained\n", 3)


def test_the_test_server_is_dropbear_with_busybox_ash(connection: SshConnection) -> None:
    assert connection._transport.remote_version.startswith("SSH-2.0-dropbear")
    assert "BusyBox" in connection.run("busybox | head -n 1").stdout


@pytest.mark.parametrize("size", [0, 1, 8192, 8193, 300_000])
def test_a_script_of_any_length_reads_exactly_its_stdin(connection: SshConnection, size: int) -> None:
    data = os.urandom(size)
    for script in ("cat", "cat # " + "long " * 1000, "\n".join(['# don\'t `stop` "here" \\ $HOME'] * 100) + "\ncat"):
        done = connection.run(script, stdin=data)
        assert done.stdout_bytes == data
        assert done.exit_status == 0


def test_stdin_stdout_and_stderr_are_streamed_concurrently_at_any_size(connection: SshConnection) -> None:
    pieces = [bytes([n % 251]) * 40_000 for n in range(40)]
    done = connection.run("tee /dev/stderr", stdin=iter(pieces))
    assert done.stdout_bytes == done.stderr_bytes == b"".join(pieces)


def test_a_command_that_ignores_its_stdin_still_ends(connection: SshConnection) -> None:
    assert connection.run("exit 4", stdin=b"x" * 1_000_000).exit_status == 4


def test_many_commands_run_over_one_connection(connection: SshConnection) -> None:
    assert [connection.run(f"echo {n}").stdout for n in range(20)] == [f"{n}\n" for n in range(20)]


def test_a_command_that_never_ends_times_out(connection: SshConnection) -> None:
    with pytest.raises(Timeout):
        connection.run("sleep 100000", timeout_s=0.5)
    assert not connection.is_open


def test_a_command_that_does_not_read_its_input_ends_at_its_deadline(connection: SshConnection) -> None:
    with pytest.raises(Timeout):
        connection.run("sleep 100000", stdin=b"x" * 4_000_000, timeout_s=0.5)


def test_a_command_killed_on_the_node_is_distinguished_from_a_failed_one(connection: SshConnection) -> None:
    with pytest.raises(ChannelClosed):
        connection.run("kill -9 $$")
    assert connection.run("echo still here").stdout == "still here\n"


@pytest.mark.parametrize("command", ["head -c 3000000 /dev/zero", "cat /dev/zero", "cat /dev/zero >&2"])
def test_too_much_output_ends_the_command_and_keeps_the_connection(
    connection: SshConnection, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("meshctl.device.ssh_channel.MAX_OUTPUT_BYTES", 1 << 20)
    with pytest.raises(OutputTooLarge, match="printed more than 1 MiB") as caught:
        connection.run(command, timeout_s=60.0)
    assert "| tail" in caught.value.hint
    assert not isinstance(caught.value, Unreachable)
    assert connection.run("echo still here").stdout == "still here\n"


def test_a_channel_closed_before_its_command_is_opened_again(
    connection: SshConnection, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As dropbear before 2024.86 does when the process of an earlier channel ends in between."""
    transport = connection._transport
    opened: list[paramiko.Channel] = []
    real = transport.open_session

    def open_and_lose_two() -> paramiko.Channel:
        channel = real()
        opened.append(channel)
        if len(opened) == 1:
            channel.close()
        if len(opened) == 2:
            raise paramiko.SSHException("Unable to open channel.")
        return channel

    monkeypatch.setattr(transport, "open_session", open_and_lose_two)
    assert connection.run("echo once").stdout == "once\n"
    assert len(opened) == 3


def test_a_server_that_dies_mid_session_is_a_lost_connection(connection: SshConnection, server: Server) -> None:
    def talk_on() -> None:
        while True:
            connection.run("echo there")

    threading.Thread(target=server.stop).start()
    with pytest.raises((ConnectionLost, ChannelClosed)):
        talk_on()


def test_rejected_keys_cause_an_authentication_error_listing_the_keys_tried(
    server: Server, trust: TrustStore, tmp_path: Path
) -> None:
    strange = [keypair(tmp_path / f"stranger-{n}") for n in range(5)]
    with pytest.raises(AuthenticationRefused) as caught:
        connect(server.endpoint(), credentials=only(*strange), trust=trust, deadlines=PATIENT)
    assert caught.value.tried == tuple(f"key {path}" for path in strange)
    assert "b03" in str(caught.value)


def test_the_right_key_is_found_after_several_wrong_ones(
    server: Server, trust: TrustStore, key: Path, tmp_path: Path
) -> None:
    strange = [keypair(tmp_path / f"stranger-{n}") for n in range(4)]
    with connect(server.endpoint(), credentials=only(*strange, key), trust=trust, deadlines=PATIENT) as connected:
        assert connected.run("true").exit_status == 0


def test_a_factory_device_lets_us_in_without_a_password(node: Sandbox, trust: TrustStore) -> None:
    give_dropbear(node, root_password="")
    trust.add("b03", host_key(node))
    empty = Credentials(use_agent=False, empty_password=True)
    with dropbear(node) as server, connect(server.endpoint(), credentials=empty, trust=trust, deadlines=PATIENT) as ssh:
        assert ssh.run("id -u").stdout == "0\n"


def test_a_device_with_a_password_refuses_the_empty_one_cleanly(server: Server, trust: TrustStore) -> None:
    empty = Credentials(use_agent=False, empty_password=True)
    with pytest.raises(AuthenticationRefused) as caught:
        connect(server.endpoint(), credentials=empty, trust=trust, deadlines=PATIENT)
    assert caught.value.tried == ("no password", "empty password")


def test_only_the_right_password_is_accepted(node: Sandbox, trust: TrustStore) -> None:
    crypted = subprocess.run(
        ["openssl", "passwd", "-6", "s3cret"], capture_output=True, text=True, check=True
    ).stdout.strip()
    give_dropbear(node, root_password=crypted)
    trust.add("b03", host_key(node))
    with dropbear(node) as server:
        right = Credentials(use_agent=False, password=Secret("s3cret"))
        with connect(server.endpoint(), credentials=right, trust=trust, deadlines=PATIENT) as ssh:
            assert ssh.run("true").exit_status == 0
        wrong = Credentials(use_agent=False, password=Secret("guess"))
        with pytest.raises(AuthenticationRefused) as caught:
            connect(server.endpoint(), credentials=wrong, trust=trust, deadlines=PATIENT)
        assert "guess" not in str(caught.value)


def test_an_agents_key_is_used(server: Server, trust: TrustStore, key: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started = subprocess.run(["ssh-agent", "-s"], capture_output=True, text=True, check=True).stdout
    values = dict(part.split("=", 1) for part in started.replace("\n", ";").split(";") if "=" in part)
    try:
        for name in ("SSH_AUTH_SOCK", "SSH_AGENT_PID"):
            monkeypatch.setenv(name, values[name])
        subprocess.run(["ssh-add", "-q", key], check=True)
        with connect(server.endpoint(), credentials=Credentials(), trust=trust, deadlines=PATIENT) as ssh:
            assert ssh.run("true").exit_status == 0
    finally:
        os.kill(int(values["SSH_AGENT_PID"]), 15)


@pytest.mark.parametrize("key_type", ["rsa", "ecdsa", "ed25519"])
def test_every_modern_key_type_serves_as_host_key_and_as_ours(
    key_type: str, node: Sandbox, trust: TrustStore, tmp_path: Path
) -> None:
    give_dropbear(node, key_types=(key_type,), root_password="!")
    key = keypair(tmp_path / "ours", key_type)
    authorize(node, public(key))
    trust.add("b03", host_key(node, key_type))
    with dropbear(node) as server, login(server.endpoint(), trust, key) as ssh:
        assert ssh.host_key == host_key(node, key_type)


def test_an_encrypted_key_requires_its_passphrase(
    node: Sandbox, server: Server, trust: TrustStore, tmp_path: Path
) -> None:
    locked = keypair(tmp_path / "locked", passphrase="open sesame")
    authorize(node, public(locked))
    wanted = Credentials(key_files=(locked,), use_agent=False, passphrase=Secret("open sesame"))
    with connect(server.endpoint(), credentials=wanted, trust=trust, deadlines=PATIENT) as ssh:
        assert ssh.run("true").exit_status == 0
    with pytest.raises(InputError, match="locked: the key is encrypted"):
        connect(server.endpoint(), credentials=only(locked), trust=trust, deadlines=PATIENT)
    with pytest.raises(InputError, match="key file not found"):
        connect(server.endpoint(), credentials=only(tmp_path / "nowhere"), trust=trust, deadlines=PATIENT)


def test_an_unknown_host_key_is_rejected_with_its_fingerprint(server: Server, tmp_path: Path, key: Path) -> None:
    with pytest.raises(HostKeyUnknown) as caught:
        connect(server.endpoint(), credentials=only(key), trust=TrustStore(tmp_path / "empty"), deadlines=PATIENT)
    assert caught.value.fingerprint.startswith("SHA256:")
    assert caught.value.fingerprint in str(caught.value)


def test_a_changed_host_key_is_refused_and_both_fingerprints_are_shown(
    node: Sandbox, trust: TrustStore, key: Path
) -> None:
    give_dropbear(node, root_password="!")
    authorize(node, public(key))
    old = host_key(node)
    trust.add("b03", old)
    new = new_host_key(node, "ed25519")
    with dropbear(node) as server, pytest.raises(HostKeyChanged) as caught:
        connect(server.endpoint(), credentials=only(key), trust=trust, deadlines=PATIENT)
    assert caught.value.pinned == (old.fingerprint,)
    assert caught.value.fingerprint == new.fingerprint


def test_the_pinned_key_is_asked_for_even_when_the_server_prefers_another(
    node: Sandbox, trust: TrustStore, key: Path
) -> None:
    give_dropbear(node, key_types=("ed25519", "rsa"), root_password="!")
    authorize(node, public(key))
    trust.add("b03", host_key(node, "rsa"))
    with dropbear(node) as server, login(server.endpoint(), trust, key) as ssh:
        assert ssh.host_key == host_key(node, "rsa")


def test_a_node_reached_through_a_jump_host_is_pinned_under_its_own_name(
    node: Sandbox, trust: TrustStore, key: Path, tmp_path: Path
) -> None:
    give_dropbear(node, root_password="!")
    behind = Sandbox(tmp_path / "behind")
    give_dropbear(behind, root_password="!")
    for each, name in ((node, "near"), (behind, "far")):
        authorize(each, public(key))
        trust.add(name, host_key(each))
    with dropbear(node) as near, dropbear(behind) as far, login(near.endpoint("near"), trust, key) as jump:
        with login(far.endpoint("far"), trust, key, via=jump) as ssh:
            assert ssh.host_key == host_key(behind)
            assert ssh.run("cat", stdin=b"x" * 100_000).stdout_bytes == b"x" * 100_000
        assert jump.run("echo still").stdout == "still\n"
        with pytest.raises(HostKeyChanged):
            login(far.endpoint("near"), trust, key, via=jump)
        nowhere = Endpoint("127.0.0.1", free_port(), identity="gone")
        with pytest.raises(Unreachable, match=r"near .* cannot reach it"):
            login(nowhere, trust, key, via=jump)


def test_a_sha1_only_server_is_accepted_only_for_openwrt_19_07_or_by_opt_in(trust: TrustStore, tmp_path: Path) -> None:
    key = keypair(tmp_path / "rsa", "rsa")
    directory = tmp_path / "openssh"
    old = ("HostKeyAlgorithms ssh-rsa", "PubkeyAcceptedAlgorithms ssh-rsa", "CASignatureAlgorithms ssh-rsa")
    with openssh(directory, public(key), *old) as server:
        pinned = parse_key((directory / "host_key.pub").read_text())
        trust.add("b03", pinned)
        endpoint, ours = server.endpoint(), only(key)
        with connect(endpoint, credentials=ours, trust=trust, release=Release.V19_07, deadlines=PATIENT) as ssh:
            assert ssh.run("echo old but here").stdout == "old but here\n"
            assert ssh.host_key == pinned
        with connect(endpoint, credentials=ours, trust=trust, legacy_rsa_sha1=True, deadlines=PATIENT) as ssh:
            assert ssh.run("true").exit_status == 0
        for release in (None, Release.V21_02, Release.V24_10):
            with pytest.raises(IncompatibleServer, match="SHA-1"):
                connect(endpoint, credentials=ours, trust=trust, release=release, deadlines=PATIENT)


def test_an_openwrt_19_07_profile_still_prefers_rsa_sha2_if_offered(
    node: Sandbox, trust: TrustStore, tmp_path: Path
) -> None:
    key = keypair(tmp_path / "rsa", "rsa")
    give_dropbear(node, key_types=("rsa",), root_password="!")
    authorize(node, public(key))
    trust.add("b03", host_key(node, "rsa"))
    with dropbear(node) as server:
        for legacy in (False, True):
            with connect(
                server.endpoint(),
                credentials=only(key),
                trust=trust,
                release=Release.V19_07,
                legacy_rsa_sha1=legacy,
                deadlines=PATIENT,
            ) as ssh:
                assert ssh._transport.host_key_type in {"rsa-sha2-512", "rsa-sha2-256"}


@contextmanager
def answering(behave: Callable[[socket.socket], None]) -> Iterator[Endpoint]:
    """A server that is none: accepts connections and does `behave` with each."""
    listener = socket.create_server(("127.0.0.1", 0))
    held: list[socket.socket] = []

    def serve() -> None:
        while True:
            try:
                peer, _ = listener.accept()
            except OSError:
                return
            held.append(peer)
            threading.Thread(target=guarded, args=(peer,), daemon=True).start()

    def guarded(peer: socket.socket) -> None:
        try:
            behave(peer)
        except OSError:
            return

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield Endpoint("127.0.0.1", listener.getsockname()[1], identity="liar")
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join(timeout=60)
        for peer in held:
            peer.close()


def silence(peer: socket.socket) -> None:
    peer.recv(1)


def banner_then_silence(peer: socket.socket) -> None:
    peer.sendall(b"SSH-2.0-dropbear_2022.83\r\n")


def flood(peer: socket.socket) -> None:
    while True:
        peer.sendall(b"no end of this " * 1000)


def web_page(peer: socket.socket) -> None:
    peer.sendall(b"HTTP/1.0 400 Bad Request\r\nContent-Type: text/html\r\n\r\n" + b"<p>no</p>\r\n" * 200)


def garbage_banner(peer: socket.socket) -> None:
    peer.sendall(b"SSH-9.9-\xff\xfe\r\n\x00\x01\x02")


def hang_up(peer: socket.socket) -> None:
    peer.shutdown(socket.SHUT_RDWR)


IMPATIENT = Deadlines(connect_s=5, handshake_s=0.5, auth_s=5, channel_s=5, run_s=5)


@pytest.mark.parametrize(
    ("behave", "deadlines", "error"),
    [
        (silence, IMPATIENT, Timeout),
        (banner_then_silence, IMPATIENT, Timeout),
        (flood, IMPATIENT, Timeout),
        (web_page, PATIENT, IncompatibleServer),
        (garbage_banner, PATIENT, IncompatibleServer),
        (hang_up, PATIENT, Unreachable),
    ],
)
def test_a_misbehaving_server_causes_a_timely_connection_error(
    behave: Callable[[socket.socket], None], deadlines: Deadlines, error: type[Exception], trust: TrustStore
) -> None:
    with answering(behave) as endpoint, pytest.raises(error, match="liar") as caught:
        connect(endpoint, credentials=Credentials(use_agent=False), trust=trust, deadlines=deadlines)
    if isinstance(caught.value, Timeout):
        assert caught.value.phase == "the SSH handshake"


def test_a_refused_connection_is_unreachable(trust: TrustStore) -> None:
    endpoint = Endpoint("127.0.0.1", free_port(), identity="b03")
    with pytest.raises(Unreachable, match=r"b03 .*cannot connect"):
        connect(endpoint, credentials=Credentials(use_agent=False), trust=trust)


def test_a_server_frozen_after_login_is_a_timeout_and_not_a_hang(
    server: Server, connection: SshConnection, node: Sandbox
) -> None:
    frozen = [pid for pid in node.processes() if b"dropbear" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    for pid in frozen:
        os.kill(pid, 19)
    try:
        with pytest.raises(Timeout):
            connection.run("echo there", timeout_s=0.5)
    finally:
        for pid in frozen:
            os.kill(pid, 18)


def test_a_silent_server_is_dropped_long_before_the_command_deadline(
    server: Server, key: Path, trust: TrustStore, node: Sandbox
) -> None:
    alert = replace(PATIENT, ask_s=0.2, silence_s=1.0)
    with connect(server.endpoint(), credentials=only(key), trust=trust, deadlines=alert) as connected:
        frozen = [pid for pid in node.processes() if b"dropbear" in Path(f"/proc/{pid}/cmdline").read_bytes()]
        for pid in frozen:
            os.kill(pid, signal.SIGSTOP)
        try:
            with pytest.raises(ConnectionLost, match="silent for 1 s during"):
                connected.run("echo there", timeout_s=100_000)
        finally:
            for pid in frozen:
                os.kill(pid, signal.SIGCONT)
        assert not connected.is_open


def test_keepalives_keep_the_connection_of_a_quiet_command_open(
    server: Server, key: Path, trust: TrustStore, node: Sandbox
) -> None:
    alert = replace(PATIENT, ask_s=0.05)
    with (
        connect(server.endpoint(), credentials=only(key), trust=trust, deadlines=alert) as connected,
        ThreadPoolExecutor(1) as pool,
    ):
        node.run("/bin/busybox", "mkfifo", "/tmp/end")
        waiting = pool.submit(connected.run, "read -r end </tmp/end; echo $end")
        first = connected._activity.last_received_s
        eventually(lambda: connected._activity.last_received_s > first)
        second = connected._activity.last_received_s
        eventually(lambda: connected._activity.last_received_s > second)
        assert not waiting.done()
        with connect(server.endpoint(), credentials=only(key), trust=trust, deadlines=PATIENT) as other:
            other.run("echo now >/tmp/end").check("end it")
        assert waiting.result().stdout == "now\n"


def test_closing_the_connection_leaves_no_server_process_on_the_node(
    server: Server, key: Path, trust: TrustStore, node: Sandbox
) -> None:
    connected = connect(server.endpoint(), credentials=only(key), trust=trust, deadlines=PATIENT)
    assert len(node.processes()) >= 2
    connected.close()
    eventually(lambda: len(node.processes()) == 1)
