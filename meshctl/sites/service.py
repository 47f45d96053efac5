"""The permanent worker of a site as a systemd unit of the gateway's login user, which needs no root."""

from __future__ import annotations

import shlex

from meshctl.device.connection import Connection
from meshctl.model import NatsHub, SiteNats
from meshctl.sites.gateway import GATEWAY_ROOT

_TIMEOUT_S = 60.0
# argv: the unit's name; standard input: the unit
_START = """
set -eu
umask 077
directory=${XDG_CONFIG_HOME:-$HOME/.config}/systemd/user
mkdir -p "$directory"
cat > "$directory/$1"
command -v systemctl >/dev/null || exit 3
# without a login session the user's systemd is not in the environment
export XDG_RUNTIME_DIR="${XDG_RUNTIME_DIR:-/run/user/$(id -u)}"
# an administrator may have done what is not allowed to the user
[ "$(loginctl show-user "$(id -un)" --property Linger --value 2>/dev/null)" = yes ] ||
	loginctl enable-linger 2>/dev/null || echo "no-linger $(id -un)"
systemctl --user daemon-reload
systemctl --user enable --quiet "$1"
systemctl --user restart "$1"
"""
_UNIT = """\
# Written by `meshctl sites install`.
[Unit]
Description=meshctl worker of site {name}

[Service]
ExecStart={command}
Restart=always
RestartSec=5
# a run continues while the worker is restarted or updated, or runs out of memory
KillMode=process
OOMPolicy=continue
# restrictions that a login user's systemd can apply without root
UMask=0077
NoNewPrivileges=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM

[Install]
WantedBy=default.target
"""


def unit_name(fleet: str, site: str) -> str:
    return f"meshctl-worker-{fleet}-{site}.service"


def unit(fleet: str, site: str, nats: SiteNats, hub: NatsHub) -> str:
    """The text of the unit."""
    words = [f"%h/{GATEWAY_ROOT}/current/bin/meshctl", "worker", f"{fleet}/{site}"]
    words += ["--nats", _quoted(nats.url), "--hub", _quoted(hub.domain)]
    return _UNIT.format(name=f"{fleet}/{site}", command=" ".join(words))


def _quoted(word: str) -> str:
    """A word of a command line in a unit, see systemd.service(5)."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"'


def start_service(connection: Connection, name: str, text: str) -> str:
    """Write the unit and start it, or restart it with a new release; returns what the administrator has to do, if
    anything."""
    script = f"printf %s {shlex.quote(text)} | sh -c {shlex.quote(_START)} sh {shlex.quote(name)}"
    done = connection.run(script, timeout_s=_TIMEOUT_S)
    if done.exit_status == 0:
        _, is_missing, user = done.stdout.strip().rpartition("no-linger ")
        if is_missing:
            return f"it ends when {user} logs out, until root runs `loginctl enable-linger {user}` there"
        return ""
    reason = (done.stderr.strip().splitlines() or ["there is no systemd"])[-1]
    return f"start {name} there ({reason}), or the command in it"
