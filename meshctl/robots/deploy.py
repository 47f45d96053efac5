"""Deploy one robot: probe -> check preconditions -> bundle -> send -> install -> switch -> `Outcome`.

The running release is not touched before `switch`, so an interrupted deploy can be repeated; files already uploaded are
not sent again. `switch` completes on the robot even if the connection breaks.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from meshctl.device.errors import ConnectionLost, Timeout
from meshctl.errors import InputError, NodeError
from meshctl.fleet import Outcome, Result
from meshctl.fleet.process import is_dead
from meshctl.model import Fleet, Secret, SecretRef
from meshctl.model.computers import ROS_1
from meshctl.robots.bundle import Bundle, bundle, has_bridge
from meshctl.robots.collector_release import RadioKnowledge, has_collector, missing_pins, own_radios, radio_archive
from meshctl.robots.expected_release import expected_release
from meshctl.robots.facts import collect_facts
from meshctl.robots.host import Host, ScriptRefused
from meshctl.robots.preconditions import (
    HostFacts,
    changed_files,
    clock_warning,
    computer_of,
    parse_facts,
    route_warning,
    routed_peers,
    unmet_disk_space,
    unmet_for_collector,
    unmet_preconditions,
)
from meshctl.robots.wheel_tags import Target
from meshctl.robots.wheels import Wheel, cache_wheels, download_wheels, has_all, select_wheels, stock_units
from meshctl.wording import counted, lock_owners

COLLECTOR_KEY = "collector_key"
"""The fact of an outcome with the collector's public key."""
_WHEEL_DIRECTORY = "/opt/udp-mesh/wheels"
PROBE_TIMEOUT_S = 120.0
# Unpacking and compiling cryptography on a small ARM board with a slow card.
INSTALL_TIMEOUT_S = 600.0
# systemd stops and starts the daemon (TimeoutStopSec, TimeoutStartSec of the unit), once for the switch and once back.
_RESTARTS_S = 240.0


@dataclass(slots=True)
class Wheelhouse:
    """Source of wheels: the `named` directory, or pip downloads in `cache`, one directory per target."""

    named: Path | None
    cache: Path
    _chosen: dict[Target, tuple[Wheel, ...]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def wheels(self, target: Target) -> tuple[Wheel, ...]:
        """All wheels for a target. Raises InputError."""
        with self._lock:
            if target not in self._chosen:
                self._chosen[target] = self._find(target)
            return self._chosen[target]

    def _find(self, target: Target) -> tuple[Wheel, ...]:
        version = ".".join(map(str, (*target.python, target.libc, *target.libc_version)))
        kept = self.cache / f"{target.arch}-{version}"
        if self.named is not None:
            chosen = select_wheels(target, self.named)
            cache_wheels(chosen, kept)
            return chosen
        # prefer cached wheels: the same robots get the same wheels, with or without internet
        if not has_all(target, kept):
            download_wheels(target, kept)
        return select_wheels(target, kept)


@dataclass(frozen=True, slots=True)
class DeployOptions:
    """Shared by all robots of one deploy.

    `now_s` returns our clock (Unix time); `wait_s` is the time a daemon has to become healthy; `only_configuration`
    refuses robots that would get other code; `radios` is for their collectors; `step` is entered with robot, step name
    and detail, and left when the step ends. `apart` are the robots that do not switch at the same time as these: on
    another port they are not heard.
    """

    fleet: Fleet
    secrets: Callable[[SecretRef], Secret]
    wheels: Callable[[Target], tuple[Wheel, ...]]
    now_s: Callable[[], float]
    wait_s: int = 30
    only_configuration: bool = False
    radios: RadioKnowledge = field(default_factory=RadioKnowledge)
    apart: frozenset[str] = frozenset()
    step: Callable[[str, str, str], AbstractContextManager[None]] = lambda robot, name, text: nullcontext()


def probe(host: Host, fleet: Fleet, robot: str) -> HostFacts:
    """Collect the facts of a computer. Changes nothing."""
    ros = ROS_1 if has_bridge(fleet, robot) else ""
    words = (computer_of(fleet, robot).python, ros, *routed_peers(fleet, robot))
    return parse_facts(host.run("probe", *words, timeout_s=PROBE_TIMEOUT_S))


def desired_bundle(options: DeployOptions, robot: str, facts: HostFacts) -> Bundle:
    """The bundle for a probed computer. Raises InputError for a missing wheel or key."""
    assert facts.target is not None, "preconditions are checked first"
    wheels = options.wheels(facts.target)
    return bundle(options.fleet, robot, options.secrets, wheels, executable=facts.executable, units=stock_units())


def plan_deploy(host: Host, robot: str, options: DeployOptions) -> tuple[HostFacts, Bundle] | Outcome:
    """The facts of a computer and its bundle, or a refusal. Changes nothing."""
    facts = probe(host, options.fleet, robot)
    computer = computer_of(options.fleet, robot)
    reasons = list(unmet_preconditions(facts, robot=robot, arch=computer.arch, python=computer.python))
    if computer.collector:
        radios = [node.name for node in own_radios(options.fleet, options.fleet.robots[robot])]
        without_pin = missing_pins(options.fleet, robot, options.radios)
        reasons += unmet_for_collector(facts, robot=robot, radios=radios, without_pin=without_pin)
    if not reasons and facts.port not in (0, options.fleet.udp_mesh.port):
        reasons += _unmet_for_port(host, robot, options, facts.port)
    if reasons:
        return _refused(robot, reasons)
    try:
        return facts, desired_bundle(options, robot, facts)
    except InputError as error:
        return Outcome(robot, Result.REFUSED, str(error), hint=error.hint)


def _unmet_for_port(host: Host, robot: str, options: DeployOptions, old: int) -> list[tuple[str, str]]:
    """A daemon on a new port does not hear peers that are still on the old one, and would be rolled back for that."""
    facts = collect_facts(host, robot, expected_release(options.fleet, robot, options.secrets), now_s=options.now_s())
    if not (left := sorted(options.apart & set(facts.online))):
        return []
    count = sum(other.computer is not None for other in options.fleet.robots.values())
    port = options.fleet.udp_mesh.port
    reason = f"its port changes from {old} to {port}, and {', '.join(left)}, which it hears, would change later"
    return [(reason, f"change all robots at once: run `MESHCTL_PARALLEL={count} meshctl robots deploy`")]


def _refused(robot: str, reasons: list[tuple[str, str]]) -> Outcome:
    return Outcome(
        robot,
        Result.REFUSED,
        "; ".join(reason for reason, _ in reasons),
        hint="; ".join(dict.fromkeys(hint for _, hint in reasons if hint)),
    )


def deploy(host: Host, robot: str, options: DeployOptions) -> Outcome:
    """Deploy the bundle to one robot. Raises NodeError for a failure before the running release was touched."""
    with options.step(robot, "look", ""):
        plan = plan_deploy(host, robot, options)
    if isinstance(plan, Outcome):
        return plan
    facts, release = plan
    if facts.current == release.id and facts.is_sound:
        with claim(host, current=facts.current) if has_collector(options.fleet, robot) else nullcontext():
            key = _prepare_collector(host, robot, options)
        same = Outcome(robot, Result.UNCHANGED, f"already runs {release.id}", facts={"release": release.id, **key})
        return _with_warnings(same, facts, options)
    if options.only_configuration and not _needs_only_reload(facts, release):
        return _refused(robot, [_more_than_configuration(facts, release)])
    is_new = release.id not in facts.releases or bool(facts.damaged)
    needed = release.unpacked_bytes if is_new and (release.tree not in facts.trees or facts.damaged) else 0
    full = list(unmet_disk_space(facts, needed)) if is_new else []
    if full:
        return _refused(robot, full)
    with claim(host, current=facts.current):
        sent = _transfer(host, robot, options, release, is_new=is_new, with_wheels=needed > 0)
        key = _prepare_collector(host, robot, options)
        how = "reload" if _needs_only_reload(facts, release) else "restart"
        with options.step(robot, "switch", f"to {release.id} ({how})"):
            outcome = switch(host, robot, release.id, how, options.wait_s)
    details = {**outcome.facts, "release": release.id, "how": how, "sent_bytes": str(sent), **key}
    return _with_warnings(replace(outcome, facts=details), facts, options)


def _transfer(
    host: Host, robot: str, options: DeployOptions, release: Bundle, *, is_new: bool, with_wheels: bool
) -> int:
    """Upload and install the release beside the running one; returns the package bytes sent."""
    sent = 0
    if with_wheels:
        size_kib = sum(len(wheel.content) for wheel in release.wheels) >> 10
        with options.step(robot, "send", f"{size_kib} KiB of packages"):
            for wheel in release.wheels:
                sent += host.put(wheel.content, f"{_WHEEL_DIRECTORY}/{wheel.stored}")
    if is_new:
        with options.step(robot, "install", release.id):
            host.run("install", release.id, release.tree, stdin=release.archive(), timeout_s=INSTALL_TIMEOUT_S)
    return sent


def _prepare_collector(host: Host, robot: str, options: DeployOptions) -> dict[str, str]:
    """Give the robot's collector the current facts about the radios. Returns its public key as a fact, if it has
    one."""
    if not has_collector(options.fleet, robot):
        return {}
    archive = radio_archive(options.fleet, robot, options.radios)
    return {COLLECTOR_KEY: host.run("collector", robot, stdin=archive, timeout_s=PROBE_TIMEOUT_S).strip()}


def _with_warnings(outcome: Outcome, facts: HostFacts, options: DeployOptions) -> Outcome:
    for remark, hint in (clock_warning(facts, options.now_s()), route_warning(facts, options.fleet, outcome.node)):
        if remark:
            hints = (text for text in (outcome.hint, hint) if text)
            outcome = replace(outcome, reason=f"{outcome.reason}; {remark}", hint="; ".join(hints))
    return outcome


def _needs_only_reload(facts: HostFacts, release: Bundle) -> bool:
    """Whether a reload of the running daemon suffices, which keeps all messages."""
    return facts.is_sound and not _other_files(facts, release)


def _other_files(facts: HostFacts, release: Bundle) -> list[str]:
    changed = changed_files(facts, release.hashes)
    return [path for path in changed if not path.startswith("etc/") and path != "topics"]


def _more_than_configuration(facts: HostFacts, release: Bundle) -> tuple[str, str]:
    if not facts.current:
        return "udp_mesh is not installed", "run `meshctl robots deploy` first"
    if not facts.is_sound:
        return "the daemon does not run as deployed", "run `meshctl robots diff`, then `meshctl robots deploy`"
    other = ", ".join(_other_files(facts, release))
    return f"more than the configuration would change ({other})", "run `meshctl robots deploy` first"


@contextmanager
def claim(host: Host, *, current: str = "-") -> Iterator[None]:
    """Lock a robot against other operators and processes, from one script to the next.

    With `current` it must still run that release. Raises ScriptRefused if another process holds or has changed it. A
    claim of a dead local process is taken over; others expire (scripts/common.sh).
    """
    reply = host.run("claim", current, "", timeout_s=PROBE_TIMEOUT_S).split()
    if reply[:1] == ["held"] and is_dead(reply[1]):
        reply = host.run("claim", current, reply[1], timeout_s=PROBE_TIMEOUT_S).split()
    if reply[:1] != ["claimed"]:
        _, holder, seconds = (*reply, "", "", "")[:3]
        hint = "wait until it is done; an abandoned claim expires after 15 minutes"
        raise ScriptRefused(f"{host.label}: locked by {lock_owners(holder)} for {seconds} s", code="busy", hint=hint)
    try:
        yield
    finally:
        # if the connection broke, the claim expires
        with suppress(NodeError):
            host.run("release", timeout_s=PROBE_TIMEOUT_S)


def switch(host: Host, robot: str, release: str, how: str, wait_s: int) -> Outcome:
    """Make an installed release the current one, or roll back."""
    try:
        output = host.run("switch", release, how, str(wait_s), timeout_s=2 * wait_s + _RESTARTS_S)
    except (Timeout, ConnectionLost) as error:
        hint = "the robot completes or rolls back the switch by itself; deploy again to find out"
        return Outcome(robot, Result.UNCERTAIN, f"{error}", hint=hint)
    return parse_switch(robot, release, output)


def parse_switch(robot: str, release: str, output: str) -> Outcome:
    """Parse the output of `scripts/switch.sh`."""
    lines = [line.partition("=") for line in output.splitlines()]
    fields = {name: value for name, _, value in lines}
    log = "\n".join(value for name, _, value in lines if name == "log" and value)
    reason = fields.get("reason", "")
    hint = f"last log lines:\n{log}" if log else ""
    match fields.get("result"):
        case "switched":
            peers = fields.get("online", "")
            peer_text = f", {counted(len(peers.split()), 'peer')} online" if peers else ""
            return Outcome(robot, Result.DONE, f"runs {release}{peer_text}", facts={"peers": peers})
        case "rolled-back":
            return Outcome(robot, Result.ROLLED_BACK, f"{reason}; the previous release runs again", hint)
        case "rolled-back-ill":
            still = fields.get("still", "") or "it does not become healthy"
            why = f"{reason}; the previous release is not healthy either: {still}"
            # a peer that was switched off meanwhile, or a link that broke
            again = "the new release may not be the cause: run the command again" if still == reason else ""
            return Outcome(robot, Result.ROLLED_BACK, why, "\n".join(filter(None, (again, hint))))
        case "removed":
            return Outcome(robot, Result.ROLLED_BACK, f"{reason}; removed, since there is no previous release", hint)
        case _:
            return Outcome(robot, Result.FAILED, f"{reason or 'no reason given'}; no release to roll back to", hint)


def roll_back(host: Host, robot: str, options: DeployOptions) -> Outcome:
    """Roll back to the previous release, which stays installed."""
    facts = probe(host, options.fleet, robot)
    hint = "run `meshctl robots deploy`"
    if facts.previous and facts.previous not in facts.releases:
        reply = f"{host.label}: the previous release {facts.previous} is damaged or missing"
        raise ScriptRefused(reply, code="no-release", hint=hint)
    if not facts.previous:
        raise ScriptRefused(f"{host.label}: there is no previous release", code="no-release", hint=hint)
    with claim(host, current=facts.current), options.step(robot, "switch", f"back to {facts.previous}"):
        return switch(host, robot, facts.previous, "restart", options.wait_s)
