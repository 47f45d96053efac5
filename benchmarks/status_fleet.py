"""Many cheap devices to measure their client with: a real dropbear for each radio, one OpenSSH server for all robots,
and prepared answers.

A radio's dropbear and what is behind it cost little here, since on a real fleet this is not our processor. In their own
network namespace, the servers have the addresses of all radios and robots. A radio's answer to the observation is that
of a recorded node (`tests/meshctl/device/recorded`), with its own MACs, four neighbors, a path to every other radio in
its originator table, and its files from the inventory. A robot runs meshctl's own script in a real shell, with
stand-ins for `systemctl` and the daemon that answer as in a team of that size.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import prepared_answers
from meshctl.device.parse.sections import split_sections
from meshctl.device.trust import TrustStore, parse_key
from meshctl.inventory import load_fleet
from meshctl.model import Secret, SecretRef
from meshctl.render import DeviceFacts, render_node

RECORDED = Path("tests/meshctl/device/recorded/23.05/mesh/observe.out")
FIRST_HALF, SECOND_HALF, COMPUTERS = "10.42.1", "10.42.2", "10.42.3"
TOPICS = {
    "emergency_stop": "{priority: 0, class: emergency_stop, rate_hz: 0.1}",
    "commands": "{priority: 1, class: command}",
    "artifacts": "{priority: 2, class: artifact}",
    "telemetry": "{priority: 3, class: telemetry, reliable: false, rate_hz: 2}",
    "map_diffs": "{priority: 6, class: map}",
    "fpv": "{priority: 9, class: video, reliable: false}",
}
_INVENTORY = """\
meshctl: 1
fleet: scale
country: US
operators: {{ssh_keys: ["{key}"]}}
hardware:
  bullet:
    board: ubnt,bullet-m-xw
    profile: ubnt_bullet-m-xw
    target: ath79/generic
    release: "23.05"
    lan_ports: [eth0]
    radios: {{radio0: {{path: platform/ahb/18100000.wmac, band: 2g, rated_power_dbm: 30, max_drive_dbm: 27}}}}
meshes:
  main: {{ssid: fleet, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, network: 10.42.0.0/16}}
defaults: {{hardware: bullet, state: deployed, ssh: {{key_files: [key]}}}}
nodes:
{nodes}robots:
{robots}topics:
{topics}"""
_RADIO = """#!/bin/sh
# Stand-in for a radio: its answers are prepared (benchmarks/prepared_answers.py).
set -- $SSH_CONNECTION
exec busybox nc "$3" {port}
"""
_DAEMON = """#!/bin/sh
# Stand-in for the release's Python that queries the daemon: its answer, by the address of the connection.
set -- $SSH_CONNECTION
for word in status topics; do
	echo "== $word"
	cat "/opt/stand-in/$3.$word.json"
	echo
done
"""
_SYSTEMCTL = """#!/bin/sh
# Stand-in for systemctl show: a running unit.
while [ $# -gt 1 ]; do shift; done
printf 'Id=%s\\nLoadState=loaded\\nActiveState=active\\nSubState=running\\nUnitFileState=enabled\\n' "$1"
printf 'NRestarts=0\\nResult=success\\n'
"""
_ENTER = r"""
root=$1
# before its interpreter may be hidden
"$2" -m benchmarks.prepared_answers "$root/answers" &
until grep -q "listening on" "$root/log"; do sleep 0.1; done
mount --make-rprivate /
mount --bind "$1/opt" /opt
mount -t tmpfs tmpfs /run
# without the start-up files of this machine's shells
mount -t tmpfs -o mode=700 tmpfs /root
mkdir -p /run/sshd -m 700 /root/.ssh
cp "$1/key.pub" /root/.ssh/authorized_keys
shift 2
# one for each radio: a dropbear refuses more than 30 logins at once
for address; do
	dropbear -F -r "$root/dropbear_key" -p "$address:22" -P "" -s -j -k -c "$root/bin/radio" </dev/null &
done
exec /usr/sbin/sshd -D -e -f "$root/sshd_config"
"""
SSHD_PORT = 2222


@dataclass(slots=True)
class Devices:
    """`start` creates everything in `directory` and listens; requires a network namespace of its own."""

    directory: Path
    radios: int
    robots: int
    _server: subprocess.Popen[bytes] | None = None

    @property
    def inventory(self) -> Path:
        return self.directory / "fleet.yaml"

    @property
    def names(self) -> tuple[str, ...]:
        return ("base", *(f"n{number:03}" for number in range(1, self.radios)))

    @property
    def team(self) -> tuple[str, ...]:
        return tuple(f"robot{number:02}" for number in range(1, self.robots + 1))

    def answer_bytes(self, rows: str) -> int:
        """The length of a radio's compressed answer: with `near` or `all` rows of originators."""
        return len(gzip.compress((self.directory / "answers" / rows / self.address(0)).read_bytes()))

    def address(self, number: int) -> str:
        """Of the radio with this place in `names`."""
        half = (self.radios + 1) // 2
        return f"{FIRST_HALF}.{number + 1}" if number < half else f"{SECOND_HALF}.{number - half + 1}"

    def start(self) -> None:
        for prefix in (FIRST_HALF, SECOND_HALF, COMPUTERS):
            _ip("route", "add", "local", f"{prefix}.0/24", "dev", "lo")
        # packets to it are never answered, as from a radio without power
        _ip("link", "add", "nowhere", "type", "veth", "peer", "name", "void")
        _ip("link", "set", "nowhere", "up")
        _ip("link", "set", "void", "up")
        for part in ("answers/near", "answers/all", "opt/stand-in", "opt/udp-mesh/releases/one/bin", "bin"):
            (self.directory / part).mkdir(parents=True)
        for name in ("key", "host_key"):
            subprocess.run(
                ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", self.directory / name], check=True, timeout=60
            )
        dropbear_key = ["dropbearkey", "-t", "ed25519", "-f", str(self.directory / "dropbear_key")]
        described = subprocess.run(dropbear_key, check=True, timeout=60, capture_output=True, text=True).stdout
        radio_key = next(line for line in described.splitlines() if line.startswith("ssh-ed25519 "))
        self._write_inventory()
        self._write_radios()
        self._write_computers()
        trust = TrustStore(self.directory / "known_hosts")
        for name in self.names:
            trust.replace(name, parse_key(radio_key))
        for robot in self.team:
            trust.replace(f"robot.{robot}", parse_key((self.directory / "host_key.pub").read_text()))
        self._listen()

    def stop(self) -> None:
        if self._server is not None:
            # the server and its namespace end with unshare
            self._server.kill()
            self._server.wait(60)

    def cpu_s(self) -> float:
        """The processor time of all devices so far: of all processes in their namespace, and of those that ended."""
        assert self._server is not None
        space = Path(f"/proc/{self._server.pid}/ns/pid_for_children").readlink()
        total_s = 0.0
        for process in Path("/proc").glob("[0-9]*"):
            # a process may end meanwhile: then its parent has its time
            with suppress(OSError):
                if (process / "ns/pid").readlink() == space:
                    total_s += process_cpu_s(int(process.name))
        return total_s

    def switch_off_half(self) -> int:
        """Silence the second half of the radios; returns their number."""
        _ip("route", "del", "local", f"{SECOND_HALF}.0/24", "dev", "lo")
        _ip("route", "add", f"{SECOND_HALF}.0/24", "dev", "nowhere")
        return self.radios // 2

    def _write_inventory(self) -> None:
        nodes = "".join(
            f"  {name}: {{role: {'base' if number == 0 else 'beacon'}, address: {self.address(number)}}}\n"
            for number, name in enumerate(self.names)
        )
        login = f"{{user: root, port: {SSHD_PORT}, key_files: [key]}}"
        robots = "".join(
            f"  {robot}: {{computer: {{address: {COMPUTERS}.{number}/16, ssh: {login}}}}}\n"
            for number, robot in enumerate(self.team, 1)
        )
        topics = "".join(f"  {name}: {text}\n" for name, text in TOPICS.items())
        key = (self.directory / "key.pub").read_text().strip()
        self.inventory.write_text(_INVENTORY.format(key=key, nodes=nodes, robots=robots, topics=topics))

    def _write_radios(self) -> None:
        fleet = load_fleet(self.inventory)
        recorded = {
            name: section.body.decode() for name, section in split_sections(RECORDED.read_bytes(), "NONCE").items()
        }
        kept = {name: body for name, body in recorded.items() if not name.startswith("config ")}
        for number, name in enumerate(self.names):
            files = render_node(fleet, name, _no_secret, device_facts=DeviceFacts("")).files
            for rows in ("near", "all"):
                sections = {**kept, **_place(number, self.radios, near=rows == "near"), **dict(_files(files))}
                answer = "".join(f"NONCE begin {key}\n{body}\nNONCE end 0\n" for key, body in sections.items())
                (self.directory / "answers" / rows / self.address(number)).write_text(answer)

    def _write_computers(self) -> None:
        root = self.directory
        release = root / "opt/udp-mesh/releases/one"
        (root / "opt/udp-mesh/current").symlink_to("releases/one")
        (release / "wheels").write_text(f"{'0' * 64}  stand-in.whl\n")
        (release / "python").write_text(f"{root}/bin/python\n")
        (release / "manifest").write_text(f"{'0' * 64}  etc/udp-mesh.toml\n")
        programs = {
            root / "bin/python": _DAEMON,
            root / "bin/systemctl": _SYSTEMCTL,
            root / "bin/radio": _RADIO.format(port=prepared_answers.PORT),
        }
        for path, text in programs.items():
            path.write_text(text)
            path.chmod(0o755)
        for number, robot in enumerate(self.team, 1):
            for word, reply in (("status", self._status(robot)), ("topics", {"topics": self._topics()})):
                (root / "opt/stand-in" / f"{COMPUTERS}.{number}.{word}.json").write_text(json.dumps(reply))

    def _status(self, robot: str) -> dict[str, Any]:
        queues = [{"priority": priority, "messages": 0, "bytes": 0, "oldest_s": 0.0} for priority in (0, 3, 6)]
        peers = [
            {
                "name": other, "online": True, "legacy": False, "address": f"{COMPUTERS}.{number}:8700",
                "link": "mesh0", "online_for_s": 3000.0, "heard_ago_s": 0.4, "round_trip_s": 0.012,
                "least_round_trip_s": 0.004, "loss": 0.02, "sent_bits_per_s": 120000.0,
                "delivered_bits_per_s": 110000.0, "received_bits_per_s": 118000.0, "capacity_bits_per_s": 6e6,
                "window_packets": 8.0, "in_flight_packets": 1, "retransmitted_packets": 12, "queues": queues,
                "outbox_messages": 0, "outbox_bytes": 0,
            }
            for number, other in enumerate(self.team, 1)
            if other != robot
        ]  # fmt: skip
        return {
            "version": "0.1.0", "wire_version": 1, "uptime_s": 3600.0, "unkeyed": True, "keys": [],
            "conditions": {"name": robot, "peers": peers, "counters": {}, "queued_bytes": 0},
        }  # fmt: skip

    @staticmethod
    def _topics() -> list[dict[str, Any]]:
        return [
            {
                "name": name, "priority": int(text.split("priority: ")[1].split(",")[0]), "configured": True,
                "sent_messages": 100, "received_messages": 1900, "sent_ago_s": 0.3, "received_ago_s": 0.2,
            }
            for name, text in TOPICS.items()
        ]  # fmt: skip

    def _listen(self) -> None:
        root = self.directory
        settings = (
            f"HostKey {root}/host_key",
            f"AuthorizedKeysFile {root}/key.pub",
            "ListenAddress 0.0.0.0",
            f"Port {SSHD_PORT}",
            "StrictModes no",
            "UsePAM no",
            "UseDNS no",
            "PidFile none",
            "PermitRootLogin yes",
            "MaxStartups 1000",
            f"SetEnv PATH={root}/bin:/usr/sbin:/usr/bin:/sbin:/bin",
        )
        (root / "sshd_config").write_text("".join(f"{line}\n" for line in settings))
        command = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", "sh", "-ec", _ENTER, "sshd"]
        log = root / "log"
        addresses = [self.address(number) for number in range(self.radios)]
        with log.open("wb") as output:
            self._server = subprocess.Popen(
                [*command, str(root), sys.executable, *addresses], stdout=output, stderr=output
            )
        deadline = time.monotonic() + 120
        while log.read_bytes().count(b"listening on") < 2 or not all(map(_listens, addresses)):
            if self._server.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"the SSH server did not start: {log.read_text()}")
            time.sleep(0.05)


def _listens(address: str) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((address, 22)) == 0


def process_cpu_s(process: int) -> float:
    """The processor time of a process and of its children that ended: proc(5), fields 14 to 17. Raises OSError."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def programs_missing() -> tuple[str, ...]:
    """The programs that must be installed."""
    return tuple(
        name
        for name in ("sshd", "ssh-keygen", "dropbear", "dropbearkey", "unshare", "ip")
        if not shutil.which(name, path=_PATH)
    )


_PATH = "/usr/sbin:/usr/bin:/sbin:/bin"


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, timeout=60, env={"PATH": _PATH})


def _mac(number: int) -> str:
    return f"02:15:6d:00:{number >> 8:02x}:{number & 255:02x}"


def _place(number: int, count: int, *, near: bool) -> dict[str, str]:
    """The sections of a radio in a ring in which each hears the two on either side; `near`: of a long table of
    originators only the rows of neighbors, as by observe.sh."""
    mac = _mac(number)
    around = sorted({(number + step) % count for step in (-2, -1, 1, 2)} - {number})
    interface = {"hard_ifindex": 7, "hard_ifname": "mesh0"}
    originators: list[Mapping[str, object]] = []
    for other in range(count):
        if other != number:
            ways = sorted(around, key=lambda way: min((way - other) % count, (other - way) % count))
            originators += [
                {**interface, "orig_address": _mac(other), **({"best": True} if place == 0 else {}),
                 "last_seen_msecs": 120 + other, "neigh_address": _mac(way), "tq": max(10, 250 - 40 * place)}
                for place, way in enumerate(ways)
            ]  # fmt: skip
    stations = "".join(
        f"Station {_mac(other)} (on mesh0)\n\tinactive time:\t40 ms\n\trx bytes:\t12400312\n\ttx bytes:\t3300121\n"
        f"\ttx packets:\t22113\n\ttx retries:\t911\n\ttx failed:\t3\n\tsignal:  \t-58 [-60, -62] dBm\n"
        f"\ttx bitrate:\t144.4 MBit/s MCS 15 short GI\n\trx bitrate:\t130.0 MBit/s MCS 15\n"
        for other in around
    )
    return {
        "clock": f"{time.time():.0f}\n",
        "macs": f"bat0 66:0f:2c:9e:01:0e 9\nbr-lan 00:15:6d:00:00:0e 8\neth0 00:15:6d:00:00:0e 2\nmesh0 {mac} 7\n",
        "iw.dev": (
            f"phy#0\n\tInterface mesh0\n\t\tifindex 7\n\t\twdev 0x2\n\t\taddr {mac}\n\t\tssid fleet\n\t\ttype IBSS\n"
            "\t\tchannel 6 (2437 MHz), width: 20 MHz, center1: 2437 MHz\n\t\ttxpower 27.00 dBm\n"
        ),
        "iw.stations mesh0": stations,
        "batctl.neighbors_json bat0": _as_batctl(
            [{**interface, "last_seen_msecs": 120, "neigh_address": _mac(other)} for other in around]
        ),
        **_originators(originators, near=near and len(_as_batctl(originators)) > 8192),
        "uci.changes": "",
        "packages": "batctl-default 2023.1-1\nkmod-batman-adv 5.15.167+2023.1-openwrt-3\niw-full 5.19-1\n",
    }


def _originators(rows: Sequence[Mapping[str, object]], *, near: bool) -> dict[str, str]:
    section = "batctl.originators_json bat0"
    if not near:
        return {section: _as_batctl(rows)}
    selected = sum("best" in row for row in rows)
    return {
        section: _as_batctl([row for row in rows if row["orig_address"] == row["neigh_address"]]),
        "batctl.originators_count bat0": f"{selected} {len(rows) - selected}\n",
    }


def _as_batctl(rows: Sequence[Mapping[str, object]]) -> str:
    return json.dumps(rows, separators=(",", ":")) + "\n"


def _files(files: Any) -> Iterator[tuple[str, str]]:
    """The files of the inventory, as the sections of a node's observation."""
    for file in files:
        text = file.content.decode()
        if file.path.startswith("etc/config/"):
            yield f"config {file.path.removeprefix('etc/config/')}", text
        else:
            path = f"/{file.path}"
            letters = "".join(
                letter if file.mode & (1 << (8 - place)) else "-" for place, letter in enumerate("rwxrwxrwx")
            )
            yield f"mode {path}", f"-{letters}    1 0        0            {len(text)} Jan  1 00:00 {path}\n"
            yield f"hash {path}", f"{hashlib.sha256(file.content).hexdigest()}  {path}\n"
            yield f"text {path}", text


def _no_secret(ref: SecretRef) -> Secret:
    raise AssertionError(f"no secret is in this inventory: {ref}")
