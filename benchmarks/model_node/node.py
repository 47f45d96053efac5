"""One model node: what it answers to a command, and how long a router would take for it. Pure.

A node is its files, its dead-man's switch and a single processor. A command is recognized by its text (`Node.answer`);
an unknown one is an error, so a benchmark never measures commands that the model does not know. `busy_s` follows from
the processes and syncs that the same command needs on a virtual node (costs.json, `python -m
benchmarks.model_node.record`) and from the pace of a 400 MHz router.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import re
import shlex
import tarfile
from dataclasses import dataclass, field
from pathlib import Path
from uuid import UUID

# A 400 MHz MIPS router: one fork and exec; one sync of jffs2; the key exchange and login of an SSH connection.
PROCESS_S, SYNC_S, LOGIN_S = 0.0035, 0.1, 2.0
# From the moment of the change until every effect is in force: procd's second, the radio, the firewall, dropbear.
RELOAD_S = 4.5

_HERE = Path(__file__).parent
RECORDED_OBSERVATION = _HERE / "observation.txt"
RECORDED_COSTS = _HERE / "costs.json"
# the first bytes of the recorded node's MACs
RECORDED_MAC = "02:4d:00:01"
_SECTION = re.compile(r"NONCE begin (?P<name>.*)\n(?P<body>(?:.*\n)*?)\nNONCE end (?P<status>\d+)\n")
_PRINTF = re.compile(r"printf %s (?P<content>.*?) >(?P<path>/\S+)\.new && mv ", re.DOTALL)


class UnknownCommand(Exception):
    """A command that the model has no answer for."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What a command needs on the node."""

    processes: int = 0
    syncs: int = 0

    @property
    def seconds(self) -> float:
        return self.processes * PROCESS_S + self.syncs * SYNC_S


@dataclass(frozen=True, slots=True)
class Answer:
    """What a command prints, its exit status, how long the processor is busy, and what else it waits for."""

    output: bytes = b""
    status: int = 0
    busy_s: float = 0.0
    not_before_s: float = 0.0


def recorded_costs() -> dict[str, Cost]:
    """Kind of command -> its cost."""
    return {kind: Cost(*found) for kind, found in json.loads(RECORDED_COSTS.read_text()).items()}


def recorded_sections() -> dict[str, tuple[str, str]]:
    """Section of the recorded observation -> (body, exit status)."""
    found = _SECTION.finditer(RECORDED_OBSERVATION.read_text())
    return {match["name"]: (match["body"], match["status"]) for match in found}


def kind_of(script: str) -> str:
    """The kind of a command. Raises UnknownCommand."""
    for kind, pattern in _KINDS:
        if re.search(pattern, script):
            return kind
    raise UnknownCommand(script[:500])


# meshctl sends a long script on standard input, to this one (`meshctl.device.framing`).
READER = "s=; while IFS= read -r l"
_WITH_INPUT = ("change", "chunk", "ansible put")


def takes_input(command: str) -> bool:
    """Whether a command reads its standard input. An unknown one does not: it gets no answer either."""
    if command.startswith(READER):
        return True
    return any(re.search(pattern, command) for kind, pattern in _KINDS if kind in _WITH_INPUT)


_KINDS = (
    ("watch", r"^mkdir -p /tmp/meshctl; pid=\$\(cat \S*/tmp/meshctl/forget\."),
    ("flush", r"(?m)^flush_(stale|restarted) "),
    ("uptime", r"^cat /proc/uptime /proc/sys/kernel/random/boot_id$"),
    ("observe", r"(?m)^\t?section done true$"),
    ("survey", r"(?m)^have=0; "),
    ("chunk", r"(?m)^cat >>\"\$p\""),
    ("place", r"echo damaged; exit 0"),
    ("remove", r"^rm -f '?/tmp/meshctl/"),
    ("lock", r"^/usr/sbin/meshctl-deadman lock "),
    ("unlock", r"^/usr/sbin/meshctl-deadman unlock "),
    ("stage", r"^/usr/sbin/meshctl-deadman stage "),
    ("arm", r"^/usr/sbin/meshctl-deadman arm "),
    ("apply", r"^/usr/sbin/meshctl-deadman apply "),
    ("change", r"^/usr/sbin/meshctl-deadman change "),
    ("status", r"/usr/sbin/meshctl-deadman status$"),
    ("confirm", r"^/usr/sbin/meshctl-deadman confirm "),
    ("ansible raw", r"^(/bin/sh -c )?'?(cat /etc/openwrt_release|test \"\$\(sha256sum)"),
    ("ansible home", r"^/bin/sh -c 'echo ~"),
    ("ansible directory", r"^/bin/sh -c '\( umask 77 && mkdir -p"),
    ("ansible put", r"^(/bin/sh -c ')?dd of="),
    ("ansible mode", r"^/bin/sh -c 'chmod "),
    ("ansible remove", r"^/bin/sh -c 'rm -f -r"),
    ("ansible script", r"^/bin/sh -c ' */root/\.ansible/tmp/"),
)


@dataclass(slots=True)
class Node:
    """A node's state. `files` have no leading slash; `now_s` arguments are the model's clock."""

    name: str
    address: str
    files: dict[str, bytes]
    version: str
    costs: dict[str, Cost]
    sections: dict[str, tuple[str, str]] = field(repr=False)
    booted_s: float = 0.0
    busy_until_s: float = 0.0
    uploads: dict[str, bytes] = field(default_factory=dict, repr=False)
    lock_owner: str = ""
    change_id: str = ""
    owner: str = ""
    state: str = "idle"
    window_s: int = 0
    due_s: float = 0.0
    new_files: dict[str, bytes] = field(default_factory=dict, repr=False)
    last: str = "last_id= last_outcome= last_reason="
    processes: int = 0
    syncs: int = 0

    def answer(self, script: str, stdin: bytes, now_s: float) -> Answer:
        """The answer to one command. Raises UnknownCommand."""
        kind = kind_of(script)
        self._advance(now_s)
        cost = self.costs.get(kind, Cost())
        self.processes += cost.processes
        self.syncs += cost.syncs
        output, status = getattr(self, "_" + kind.replace(" ", "_"))(script, stdin, now_s + cost.seconds)
        not_before_s = self.due_s + RELOAD_S if kind == "change" else 0.0
        return Answer(output.encode(), status, cost.seconds, not_before_s)

    def _advance(self, now_s: float) -> None:
        if self.state == "waiting" and now_s >= self.due_s:
            self.state = "applied"
            self.files.update(self.new_files)
            # the detached process and the reload
            cost = self.costs.get("reload", Cost())
            self.processes += cost.processes
            self.syncs += cost.syncs

    # --- meshctl ---

    def _observe(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        nonce = _value(script, "N")
        sections = dict(self.sections)
        sections["uptime"] = (f"{now_s - self.booted_s:.2f} 1.00\n", "0")
        sections["boot_id"] = (f"{self._boot_id}\n", "0")
        sections["deadman"] = (self._status_line(now_s), "0")
        for name in [name for name in sections if name.startswith("config ")]:
            del sections[name]
        done = sections.pop("done")
        for path, content in sorted(self.files.items()):
            if path.startswith("etc/config/"):
                sections[f"config {path.rpartition('/')[2]}"] = (content.decode() + "\n", "0")
        for path in _value(script, "EXTRA").split():
            found = self.files.get(path.lstrip("/"))
            sections[f"mode {path}"] = ("", "1") if found is None else (
                f"-rw-r--r--    1 0        0        {len(found):9d} Nov  1 12:00 {path}\n", "0"
            )  # fmt: skip
            if found is not None:
                sections[f"hash {path}"] = (f"{hashlib.sha256(found).hexdigest()}  {path}\n", "0")
                sections[f"text {path}"] = (found.decode(), "0")
        sections["authorized_keys"] = (self.files.get("etc/dropbear/authorized_keys", b"").decode(), "0")
        sections["done"] = done
        text = "".join(
            f"{nonce} begin {name}\n{body}\n{nonce} end {status}\n" for name, (body, status) in sections.items()
        )
        return text.replace("n001", self.name).replace('"10.42.1.1"', f'"{self.address}"'), 0

    def _status_line(self, now_s: float) -> str:
        left = due = reloaded = ""
        if self.state in ("waiting", "applied"):
            due = f"{self.due_s - self.booted_s:.2f}"
        if self.state == "applied":
            left = str(int(self.due_s + self.window_s - now_s))
            reloaded = "0" if now_s >= self.due_s + RELOAD_S else ""
        return (
            f"version={self.version} state={self.state} id={self.change_id} owner={self.owner} "
            f"window_s={self.window_s} left_s={left} due_uptime_s={due} reload_status={reloaded} "
            f"lock_owner={self.lock_owner} lock_left_s=100 {self.last} uptime_s={now_s - self.booted_s:.2f}\n"
        )

    @property
    def _boot_id(self) -> str:
        return str(UUID(bytes=hashlib.md5(self.name.encode()).digest()))

    def _uptime(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        return f"{now_s - self.booted_s:.2f} 1.00\n{self._boot_id}\n", 0

    def _watch(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        return "watching\n", 0

    def _flush(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        """No station entry is stale."""
        asked = re.findall(r"(?m)^flush_(?:stale|restarted) .* '?((?:[0-9a-f]{2}:){5}[0-9a-f]{2})'? \d+$", script)
        return "".join(f"answers {mac}\n" for mac in asked), 0

    def _survey(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        return "", 0

    def _chunk(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        self.uploads["part"] = stdin
        return f"{hashlib.sha256(stdin).hexdigest()}  -\n", 0

    def _place(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        match = re.search(r" t=(\S+)", script)
        self.uploads[match[1] if match else ""] = self.uploads.pop("part")
        return "placed\n", 0

    def _remove(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        self.uploads.clear()
        return "", 0

    def _lock(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        self.lock_owner = script.split()[2]
        return f"ok lock_owner={self.lock_owner}\n", 0

    def _unlock(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        self.lock_owner = ""
        return "ok\n", 0

    def _stage(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        _, _, self.owner, self.change_id, path = script.split()
        self._unpack(self.uploads[path])
        return f"ok state=staged id={self.change_id}\n", 0

    def _change(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        _, _, self.owner, _, self.change_id, _, window_s, _, _ = script.split()
        self.lock_owner, self.window_s = self.owner, int(window_s)
        self._unpack(stdin)
        self.state, self.due_s = "waiting", now_s
        return f"ok id={self.change_id} reload_status=0\n", 0

    def _unpack(self, bundle: bytes) -> None:
        with tarfile.open(fileobj=io.BytesIO(gzip.decompress(bundle))) as tar:
            files = {member.name: tar.extractfile(member) for member in tar if member.name.startswith("new/")}
            self.new_files = {name[4:]: stream.read() for name, stream in files.items() if stream is not None}
        self.state = "staged"

    def _arm(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        self.state, self.window_s = "armed", int(script.split()[-1])
        return f"ok state=armed id={self.change_id}\n", 0

    def _apply(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        *_, clock, at_s = script.split()
        self.state, self.due_s = "waiting", float(at_s) + (self.booted_s if clock == "at" else now_s)
        return f"ok state=waiting id={self.change_id} due_uptime_s={self.due_s - self.booted_s:.2f}\n", 0

    def _status(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        return self._status_line(now_s), 0

    def _confirm(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        ended, self.state, self.change_id = self.change_id, "idle", ""
        self.lock_owner = ""
        self.last = f"last_id={ended} last_outcome=confirmed last_reason=operator"
        return f"ok state=idle id={ended} outcome=confirmed\n", 0

    # --- ansible ---

    def _ansible_raw(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        match = re.search(r"sha256sum <(/\S+?)\)\" = \"([0-9a-f]+)", script)
        if match is None:
            return self.sections["openwrt_release"][0], 0
        return "", int(hashlib.sha256(self.files[match[1].lstrip("/")]).hexdigest() != match[2])

    def _ansible_home(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        return "/root\n", 0

    def _ansible_directory(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        match = re.search(r"ansible-tmp-[0-9.-]+", script)
        name = match[0] if match else ""
        return f"{name}=/root/.ansible/tmp/{name}\n", 0

    def _ansible_put(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        self.uploads["script"] = stdin
        return "", 0

    def _ansible_mode(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        return "", 0

    def _ansible_remove(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        return "", 0

    def _ansible_script(self, script: str, stdin: bytes, now_s: float) -> tuple[str, int]:
        reload = self.costs.get("ansible reload", Cost())
        self.processes += reload.processes
        self.syncs += reload.syncs
        pushed = self.uploads.pop("script").decode()
        for match in _PRINTF.finditer(pushed):
            (content,) = shlex.split(match["content"])
            self.files[match["path"].lstrip("/")] = content.encode()
        return "", 0


def _value(script: str, name: str) -> str:
    """The value of the assignment `NAME=VALUE` at the start of a line."""
    match = re.search(rf"(?m)^{name}=(.*)$", script)
    words = shlex.split(match[1]) if match else []
    return words[0] if words else ""
