"""One robot brought to what the inventory says: probe -> object -> bundle -> send -> install -> switch -> `Outcome`.

Until `switch` nothing that runs is touched, and a deploy that is cut anywhere before is simply done again: what has
arrived stays and is not sent twice. `switch` runs to its end on the robot whatever happens to the link.
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
from meshctl.robots.host import Host, ScriptRefused
from meshctl.robots.preconditions import (
    HostFacts,
    changed_files,
    clock_warning,
    computer_of,
    parse_facts,
    unmet_disk_space,
    unmet_preconditions,
)
from meshctl.robots.wheel_tags import Target
from meshctl.robots.wheels import Wheel, cache_wheels, download_wheels, has_all, select_wheels, stock_units

_WHEEL_DIRECTORY = "/opt/udp-mesh/wheels"
PROBE_TIMEOUT_S = 120.0
# Unpacking and compiling cryptography on a small ARM board with a slow card.
INSTALL_TIMEOUT_S = 600.0
# What systemd may take to stop and start the daemon (TimeoutStopSec, TimeoutStartSec of the unit), both ways.
_RESTARTS_S = 240.0


@dataclass(slots=True)
class Wheelhouse:
    """Where wheels come from: the directory the operator named, or pip's downloads in `cache`, one folder a target."""

    named: Path | None
    cache: Path
    _chosen: dict[Target, tuple[Wheel, ...]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def wheels(self, target: Target) -> tuple[Wheel, ...]:
        """All that a target needs. Raises InputError."""
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
        # kept from before: the same robots get the same wheels, with or without internet
        if not has_all(target, kept):
            download_wheels(target, kept)
        return select_wheels(target, kept)


@dataclass(frozen=True, slots=True)
class DeployOptions:
    """What all robots of one deploy share.

    `now_s` reads the operator's clock (Unix time); `wait_s` is how long a daemon may take to prove itself; with
    `only_configuration` a robot that would get other code is refused; `step` gets a robot, the step's name and a few
    words more, and is left when the step ends.
    """

    fleet: Fleet
    secrets: Callable[[SecretRef], Secret]
    wheels: Callable[[Target], tuple[Wheel, ...]]
    now_s: Callable[[], float]
    wait_s: int = 30
    only_configuration: bool = False
    step: Callable[[str, str, str], AbstractContextManager[None]] = lambda robot, name, text: nullcontext()


def probe(host: Host, fleet: Fleet, robot: str) -> HostFacts:
    """What the computer is and has. Changes nothing."""
    ros = ROS_1 if has_bridge(fleet, robot) else ""
    return parse_facts(host.run("probe", computer_of(fleet, robot).python, ros, timeout_s=PROBE_TIMEOUT_S))


def desired_bundle(options: DeployOptions, robot: str, facts: HostFacts) -> Bundle:
    """The bundle for a probed computer. Raises InputError where a wheel or a key is missing."""
    assert facts.target is not None, "objections come first"
    wheels = options.wheels(facts.target)
    return bundle(options.fleet, robot, options.secrets, wheels, executable=facts.executable, units=stock_units())


def plan_deploy(host: Host, robot: str, options: DeployOptions) -> tuple[HostFacts, Bundle] | Outcome:
    """The probed computer and what it shall have; an outcome for one that cannot have it. Changes nothing."""
    facts = probe(host, options.fleet, robot)
    computer = computer_of(options.fleet, robot)
    reasons = list(unmet_preconditions(facts, robot=robot, arch=computer.arch, python=computer.python))
    if reasons:
        return _refused(robot, reasons)
    try:
        return facts, desired_bundle(options, robot, facts)
    except InputError as error:
        return Outcome(robot, Result.REFUSED, str(error), hint=error.hint)


def _refused(robot: str, reasons: list[tuple[str, str]]) -> Outcome:
    return Outcome(
        robot,
        Result.REFUSED,
        "; ".join(reason for reason, _ in reasons),
        hint="; ".join(dict.fromkeys(hint for _, hint in reasons if hint)),
    )


def deploy(host: Host, robot: str, options: DeployOptions) -> Outcome:
    """Bring one robot to its bundle. Raises NodeError where it fails before anything that runs was touched."""
    with options.step(robot, "look", ""):
        plan = plan_deploy(host, robot, options)
    if isinstance(plan, Outcome):
        return plan
    facts, release = plan
    if facts.current == release.id and facts.is_sound:
        same = Outcome(robot, Result.UNCHANGED, f"already runs {release.id}", facts={"release": release.id})
        return _with_clock_warning(same, facts, options)
    if options.only_configuration and not _only_configuration(facts, release):
        return _refused(robot, [_more_than_configuration(facts, release)])
    is_new = release.id not in facts.releases or bool(facts.damaged)
    needed = release.unpacked_bytes if is_new and (release.tree not in facts.trees or facts.damaged) else 0
    full = list(unmet_disk_space(facts, needed)) if is_new else []
    if full:
        return _refused(robot, full)
    with claim(host, current=facts.current):
        sent = _transfer(host, robot, options, release, is_new=is_new, with_wheels=needed > 0)
        how = "reload" if _only_configuration(facts, release) else "restart"
        with options.step(robot, "switch", f"to {release.id} ({how})"):
            outcome = switch(host, robot, release.id, how, options.wait_s)
    told = {**outcome.facts, "release": release.id, "how": how, "sent_bytes": str(sent)}
    return _with_clock_warning(replace(outcome, facts=told), facts, options)


def _transfer(
    host: Host, robot: str, options: DeployOptions, release: Bundle, *, is_new: bool, with_wheels: bool
) -> int:
    """Put the release beside what runs; the bytes of packages that had to travel."""
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


def _with_clock_warning(outcome: Outcome, facts: HostFacts, options: DeployOptions) -> Outcome:
    remark, hint = clock_warning(facts, options.now_s())
    if not remark:
        return outcome
    return replace(
        outcome, reason=f"{outcome.reason}; {remark}", hint="; ".join(text for text in (outcome.hint, hint) if text)
    )


def _only_configuration(facts: HostFacts, release: Bundle) -> bool:
    """Whether the running daemon can take the new release by reading its files again, losing nothing it holds."""
    return facts.is_sound and not _other_files(facts, release)


def _other_files(facts: HostFacts, release: Bundle) -> list[str]:
    changed = changed_files(facts, release.hashes)
    return [path for path in changed if not path.startswith("etc/") and path != "topics"]


def _more_than_configuration(facts: HostFacts, release: Bundle) -> tuple[str, str]:
    if not facts.current:
        return "udp_mesh is not installed there", "`meshctl robots deploy` first"
    if not facts.is_sound:
        return "the daemon there does not run as it was deployed", "`meshctl robots diff`, then `meshctl robots deploy`"
    other = ", ".join(_other_files(facts, release))
    return f"more than the configuration would change ({other})", "`meshctl robots deploy` first"


@contextmanager
def claim(host: Host, *, current: str = "-") -> Iterator[None]:
    """Hold a robot against other operators and processes, from one script to the next.

    With `current` it must still run that release. Raises Refused for one that another process holds or has changed. A
    claim whose process on this computer has died is taken over; others end by themselves (scripts/common.sh).
    """
    told = host.run("claim", current, "", timeout_s=PROBE_TIMEOUT_S).split()
    if told[:1] == ["held"] and is_dead(told[1]):
        told = host.run("claim", current, told[1], timeout_s=PROBE_TIMEOUT_S).split()
    if told[:1] != ["claimed"]:
        _, holder, seconds = (*told, "", "", "")[:3]
        hint = "wait until it is done; a claim that nobody gives back ends by itself after 15 minutes"
        raise ScriptRefused(f"{host.label}: {holder} changes this robot, for {seconds} s now", code="busy", hint=hint)
    try:
        yield
    finally:
        # where the link broke, the claim ends as said above
        with suppress(NodeError):
            host.run("release", timeout_s=PROBE_TIMEOUT_S)


def switch(host: Host, robot: str, release: str, how: str, wait_s: int) -> Outcome:
    """Make an installed release the current one, or stay with the one before."""
    try:
        told = host.run("switch", release, how, str(wait_s), timeout_s=2 * wait_s + _RESTARTS_S)
    except (Timeout, ConnectionLost) as error:
        hint = "the robot finishes or undoes the switch by itself; deploy again to see which"
        return Outcome(robot, Result.UNCERTAIN, f"{error}", hint=hint)
    return parse_switch(robot, release, told)


def parse_switch(robot: str, release: str, told: str) -> Outcome:
    """The outcome in what `scripts/switch.sh` prints."""
    lines = [line.partition("=") for line in told.splitlines()]
    one = {name: value for name, _, value in lines}
    log = "\n".join(value for name, _, value in lines if name == "log" and value)
    reason = one.get("reason", "")
    hint = f"its last words:\n{log}" if log else ""
    match one.get("result"):
        case "switched":
            peers = one.get("online", "")
            told_peers = f", {len(peers.split())} peers online" if peers else ""
            return Outcome(robot, Result.DONE, f"runs {release}{told_peers}", facts={"peers": peers})
        case "rolled-back":
            return Outcome(robot, Result.ROLLED_BACK, f"{reason}; the release before runs again", hint)
        case "rolled-back-ill":
            still = one.get("still", "") or "it does not prove itself"
            why = f"{reason}; went back to the release before, which is not well either: {still}"
            return Outcome(robot, Result.ROLLED_BACK, why, hint)
        case "removed":
            return Outcome(robot, Result.ROLLED_BACK, f"{reason}; there was no release before, so it was removed", hint)
        case _:
            return Outcome(robot, Result.FAILED, f"{reason or 'the switch said nothing'}; nothing to go back to", hint)


def roll_back(host: Host, robot: str, options: DeployOptions) -> Outcome:
    """Go back to the release before, which stays installed for this."""
    facts = probe(host, options.fleet, robot)
    hint = "`meshctl robots deploy` brings what the inventory says"
    if facts.previous and facts.previous not in facts.releases:
        told = f"{host.label}: the release before, {facts.previous}, is damaged there, or gone"
        raise ScriptRefused(told, code="no-release", hint=hint)
    if not facts.previous:
        raise ScriptRefused(
            f"{host.label}: there is no release before {facts.current or 'this'}", code="no-release", hint=hint
        )
    with claim(host, current=facts.current), options.step(robot, "switch", f"back to {facts.previous}"):
        return switch(host, robot, facts.previous, "restart", options.wait_s)
