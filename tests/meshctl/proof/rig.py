"""A virtual fleet, two inventories to go back and forth between, and meshctl as a process that can be killed.

`Rig.up` starts the nodes and takes them into the fleet; `meshctl` runs a command to its end, `start` begins one;
`state_of` reads a node's flash and says whether it is wholly `old`, wholly `new`, or `mixed`.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from types import MappingProxyType, TracebackType
from typing import Any, Self

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from meshctl.inventory import load_fleet
from meshctl.model import Release, Secret, SecretRef
from meshctl.render import DeviceFacts, render_node
from meshctl.uci import parse
from meshlab.fleet import VirtualFleet
from meshlab.spec import MESH_PACKAGES, FleetSpec, LinkSpec, Medium, NodeSpec
from tests.meshctl import forked_commands
from tests.meshctl.inventories import compex_hardware

QUORUM = 0.6
COMMAND_LIMIT_S = forked_commands.LIMIT_S
INVENTORY = """\
meshctl: 1
fleet: proof
country: US
operators:
  ssh_keys: ["{key}"]
system: {{log_size_kib: {log_size}}}
apply: {{max_down: {count}, canary: false, stop_after_failures: 100000, quorum: {quorum}{policy}}}
hardware:
{hardware}{firmware}
meshes:
  main:
    ssid: proof
    bssid: 02:ca:fe:00:00:01
    band: 2g
    channel: {channel}
    distance_m: {distance}
    network: 10.42.0.0/16
    batman: {{hop_penalty: {penalty}}}
defaults: {{hardware: box, state: deployed}}
nodes:
  base: {{role: base, address: 10.42.0.1}}
  n[001-{count:03}]: {{role: beacon, address: {{from: 10.42.1.1}}}}
"""


@dataclass(frozen=True, slots=True)
class Ended:
    """What a meshctl process said: its exit code and, of `--json`, one object per line."""

    code: int
    out: str
    err: str

    @property
    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.out.splitlines() if line.startswith("{")]

    @property
    def results(self) -> dict[str, str]:
        """Node -> result."""
        ended = [event for event in self.events if event.get("event") == "ended"]
        return {item["node"]: item["result"] for item in ended[-1]["outcomes"]} if ended else {}

    @property
    def verdicts(self) -> dict[str, str]:
        """Node -> verdict, of `provision --check --json`."""
        return {name: item["verdict"] for name, item in json.loads(self.out)["nodes"].items()}


def run(words: Sequence[str], environ: Mapping[str, str]) -> Ended:
    """Run a command of meshctl to its end."""
    with TemporaryFile() as out, TemporaryFile() as err:
        process = forked_commands.start(words, environ, out, err)
        try:
            code = process.wait(COMMAND_LIMIT_S)
        finally:
            process.kill()
        out.seek(0)
        err.seek(0)
        return Ended(code, out.read().decode(), err.read().decode())


@dataclass(slots=True)
class Rig:
    """A base and `count` nodes around it, every one also wired to the bench."""

    directory: Path
    count: int
    # a reload alone takes 3 s, and more on a busy machine
    window_s: int = 40
    # of the inventory's `apply`; None: not set
    parallel: int | None = 8
    # further lines of the hardware profile, by inventory
    firmware: Mapping[str, str] = field(default_factory=dict)
    # what is baked into the images
    packages: tuple[str, ...] = MESH_PACKAGES
    # whether meshctl knows that the fleet is virtual; otherwise it uses addresses and cables as in the field
    knows_lab: bool = True
    release: Release = Release.V23_05
    # each node hears the one before and the one after it, instead of the base
    is_chain: bool = False
    # node -> `NodeSpec.slowness`, where it is not 1
    slowness: Mapping[str, int] = field(default_factory=dict)
    # the traffic classes that a stale station entry drops: `FleetSpec.stale`
    stale: tuple[str, ...] = ("ordinary", "logins")
    fleet: VirtualFleet = field(init=False)
    # which of the inventories a and b the nodes run
    current: str = "a"
    # (inventory, node, compat_version) -> files: most tests begin with a comparison of all nodes with both inventories
    _rendered: dict[tuple[str, str, str], dict[str, bytes]] = field(default_factory=dict, repr=False)

    def __enter__(self) -> Self:
        self.directory.mkdir(parents=True, exist_ok=True)
        private = Ed25519PrivateKey.generate()
        self._key.write_bytes(
            private.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.OpenSSH, serialization.NoEncryption()
            )
        )
        self._key.chmod(0o600)
        public = private.public_key().public_bytes(serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH)
        for number, variant in enumerate(VARIANTS):
            text = INVENTORY.format(
                key=public.decode() + " proof",
                count=self.count,
                quorum=QUORUM,
                hardware=compex_hardware(self.release.value, confirm_window_s=self.window_s),
                policy="" if self.parallel is None else f", parallel: {self.parallel}",
                firmware=self.firmware.get(variant, ""),
                log_size=64 + number,
                channel=SPLIT_CHANNELS[number] if variant == "split" else 6,
                distance=1000 + number,
                penalty=30 + number,
            )
            self.inventory(variant).write_text(text, encoding="utf-8")
        names = ["base", *self.names]
        nodes = tuple(
            NodeSpec(
                name,
                release=self.release,
                medium=Medium.BASE if name == "base" else Medium.BENCH,
                host_key_types=("ed25519",),
                packages=self.packages,
                slowness=self.slowness.get(name, 1),
            )
            for name in names
        )
        nearer = names[:-1] if self.is_chain else ["base"] * self.count
        links = tuple(LinkSpec(near, name) for near, name in zip(nearer, self.names, strict=True))
        # nodes boot within a second: those around them still know their radios
        spec = FleetSpec("proof", nodes, links, quick_boot=True, stale=self.stale)
        self.fleet = VirtualFleet(spec, self.directory / "lab").up(wait_s=60.0 + 5.0 * self.count)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.fleet.down()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"n{number:03}" for number in range(1, self.count + 1))

    @property
    def _key(self) -> Path:
        return self.directory / "key"

    def flip(self) -> tuple[str, str]:
        """The inventory the nodes run and the one they shall run next, which counts as current from now on."""
        old, self.current = self.current, {"a": "b", "b": "a"}[self.current]
        return old, self.current

    def inventory(self, variant: str) -> Path:
        return self.directory / f"{variant}.yaml"

    @property
    def environ(self) -> dict[str, str]:
        root = str(Path(__file__).resolve().parents[3])
        return {
            **{name: text for name, text in os.environ.items() if not name.startswith("MESHCTL_")},
            "XDG_STATE_HOME": str(self.directory / "state"),
            **({"MESHCTL_LAB": str(self.fleet.directory)} if self.knows_lab else {}),
            "PYTHONPATH": root,
            "SSH_AUTH_SOCK": "",
        }

    def start(self, verb: str, variant: str, *words: str, command: Sequence[str] = ()) -> subprocess.Popen[str]:
        """Begin a verb of meshctl on inventory `variant` (empty: the verb takes none); `command` is for the nodes."""
        return subprocess.Popen(
            [sys.executable, "-m", "meshctl", *self._words(verb, variant, words, command)],
            env=self.environ,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def meshctl(
        self,
        verb: str,
        variant: str,
        *words: str,
        command: Sequence[str] = (),
        environ: Mapping[str, str] = MappingProxyType({}),
    ) -> Ended:
        """Run it to its end; `environ` are further variables."""
        return run(self._words(verb, variant, words, command), {**self.environ, **environ})

    def _words(self, verb: str, variant: str, words: Sequence[str], command: Sequence[str]) -> list[str]:
        return [
            verb,
            *words,
            *(("-i", str(self.inventory(variant)), "--key", str(self._key)) if variant else ()),
            *(("--", *command) if command else ()),
        ]

    def take_in(self, variant: str) -> Ended:
        """Bootstrap every node with inventory `variant`."""
        return self.meshctl("bootstrap", variant, "--yes", "--json")

    def rendered(self, variant: str, name: str, compat_version: str) -> dict[str, bytes]:
        """The files that inventory `variant` wants of a node, without the leading slash."""
        inventory = self.inventory(variant)
        key = (inventory.read_text(encoding="utf-8"), name, compat_version)
        if key not in self._rendered:
            found = render_node(load_fleet(inventory), name, _no_secret, device_facts=DeviceFacts(compat_version))
            self._rendered[key] = {file.path: file.content for file in found.files}
        return self._rendered[key]

    def state_of(self, name: str, old: str, new: str) -> str:
        """`old`, `new`, or `mixed` with the paths that are neither here nor there."""
        there = self._files(name)
        before, after = (self._rendered_for(there, variant, name) for variant in (old, new))
        differing = [path for path in after if before.get(path) != after[path]]
        if all(there.get(path) == after[path] for path in differing):
            return "new"
        if all(there.get(path) == before[path] for path in differing):
            return "old"
        return "mixed: " + ", ".join(path for path in differing if there.get(path) != before[path])

    def variant_of(self, name: str, there: Mapping[str, bytes] | None = None) -> str:
        """Which inventory the node's files are wholly of, or `a mixture`; `there` are files of a backup instead."""
        there = self._files(name) if there is None else there
        rendered = {variant: self._rendered_for(there, variant, name) for variant in VARIANTS}
        differing = [path for path, first in rendered["a"].items() if any(r[path] != first for r in rendered.values())]
        for variant, files in rendered.items():
            if all(there.get(path) == files[path] for path in differing):
                return variant
        return "a mixture"

    def has_files_of(self, device: str, variant: str, name: str) -> bool:
        """Whether a device has all files that inventory `variant` wants of node `name`."""
        there = self._files(device)
        return all(there.get(path) == content for path, content in self._rendered_for(there, variant, name).items())

    def _rendered_for(self, there: Mapping[str, bytes], variant: str, name: str) -> dict[str, bytes]:
        """What inventory `variant` wants of a node that has these files."""
        system = parse(there.get("etc/config/system", b"").decode(), "system")
        compat = next((text for section in system.sections if (text := section.get("compat_version"))), "")
        return self.rendered(variant, name, compat)

    def _files(self, name: str) -> dict[str, bytes]:
        done = self.fleet.node(name).exec("cd / && tar -cf - etc/config etc/dropbear etc/meshctl/node")
        files = {}
        with tarfile.open(fileobj=io.BytesIO(done.stdout_bytes)) as tar:
            for member in tar:
                stream = tar.extractfile(member)
                if stream is not None:
                    files[member.name] = stream.read()
        return files

    def settle(self) -> None:
        """Repaired, up and completely on `current`, whatever was done before."""
        self.fleet.repair()
        self.wait_all_up()
        other = "b" if self.current == "a" else "a"
        if any(self.state_of(name, other, self.current) != "new" for name in ("base", *self.names)):
            self.current = "a"
            ended = self.meshctl("provision", "a", "--yes", "--json")
            if ended.code != 0:
                raise AssertionError(f"the fleet cannot be brought back: {ended.out} {ended.err}")

    def wait_all_up(self, off: Sequence[str] = ()) -> None:
        """Wait for all nodes except those that are `off`."""
        for name in ("base", *self.names):
            if name not in off:
                self.fleet.node(name).wait_up(wait_s=120.0)


# a, b: another distance, hop penalty and log size; split: another channel
VARIANTS = ("a", "b", "split")
SPLIT_CHANNELS = (6, 6, 11)


def _no_secret(ref: SecretRef) -> Secret:
    raise AssertionError(f"no secret is in these inventories: {ref}")
