"""systemd receives the daemon's notifications, and a missing systemd is harmless."""

import os
import socket
from pathlib import Path

import pytest

from udp_mesh.daemon.sd_notify import Notifier


@pytest.mark.parametrize("abstract", [False, True])
def test_every_state_reaches_the_socket(tmp_path: Path, abstract: bool) -> None:
    address = f"\0udp-mesh-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address)
        systemd.settimeout(60)
        notifier = Notifier({"NOTIFY_SOCKET": address.replace("\0", "@")})
        notifier.ready("ugv1: 2 of 3 peers online")
        notifier.alive("x")
        notifier.reloading()
        notifier.stopping()
        notifier.close()
        heard = [systemd.recv(1000).decode() for _ in range(4)]
    assert heard[0] == "READY=1\nSTATUS=ugv1: 2 of 3 peers online"
    assert heard[1].startswith("WATCHDOG=1")
    assert heard[2].startswith("RELOADING=1\nMONOTONIC_USEC=")
    assert heard[3] == "STOPPING=1"


def test_without_systemd_nothing_is_sent() -> None:
    notifier = Notifier({})
    notifier.ready("status")
    notifier.close()
    assert notifier.watchdog_s is None


def test_a_missing_notify_socket_is_not_an_error(tmp_path: Path) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")})
    notifier.alive("status")
    notifier.close()


@pytest.mark.parametrize(
    ("environment", "period_s"),
    [
        ({"WATCHDOG_USEC": "10000000"}, 5.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())}, 5.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
    ],
)
def test_the_watchdog_interval_is_half_the_configured_timeout(
    environment: dict[str, str], period_s: float | None
) -> None:
    assert Notifier(environment).watchdog_s == period_s
