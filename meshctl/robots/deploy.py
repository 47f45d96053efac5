"""One robot brought to what the inventory says: probe -> object -> bundle -> send -> install -> switch -> `Outcome`.

Until `switch` nothing that runs is touched, and a deploy that is cut anywhere before is simply done again: what has
arrived stays and is not sent twice. `switch` runs to its end on the robot whatever happens to the link.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from meshctl.device.errors import ConnectionLost, Timeout
from meshctl.errors import InputError
from meshctl.fleet import Outcome, Result
from meshctl.model import Computer, Fleet, Secret, SecretRef
from meshctl.robots.bundle import Bundle, bundle
from meshctl.robots.host import Host, Refused
from meshctl.robots.tags import Target
from meshctl.robots.target import Facts, changed_files, objections, parse_facts, room_objection
from meshctl.robots.wheels import Wheel, choose, fetch, has_all, keep, stock_units

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
            chosen = choose(target, self.named)
            keep(chosen, kept)
            return chosen
        # kept from before: the same robots get the same wheels, with or without internet
        if not has_all(target, kept):
            fetch(target, kept)
        return choose(target, kept)


@dataclass(frozen=True, slots=True)
class Order:
    """What all robots of one deploy share.

    `now_s` reads the operator's clock (Unix time); `wait_s` is how long a daemon may take to prove itself; with
    `only_configuration` a robot that would get other code is refused; `tell` gets a robot and the step it begins.
    """

    fleet: Fleet
    secrets: Callable[[SecretRef], Secret]
    wheels: Callable[[Target], tuple[Wheel, ...]]
    now_s: Callable[[], float]
    wait_s: int = 30
    only_configuration: bool = False
    tell: Callable[[str, str], None] = lambda robot, step: None


def probe(host: Host, python: str) -> Facts:
    """What the computer is and has. Changes nothing."""
    return parse_facts(host.run("probe", python, timeout_s=PROBE_TIMEOUT_S))


def wanted(order: Order, robot: str, facts: Facts) -> Bundle:
    """The bundle for a probed computer. Raises InputError where a wheel or a key is missing."""
    assert facts.target is not None, "objections come first"
    wheels = order.wheels(facts.target)
    return bundle(order.fleet, robot, order.secrets, wheels, executable=facts.executable, units=stock_units())


def refusal(order: Order, robot: str, computer: Computer, facts: Facts) -> Outcome | None:
    """The outcome for a computer that cannot run udp_mesh; None when it can."""
    reasons = list(objections(facts, robot=robot, arch=computer.arch, python=computer.python, now_s=order.now_s()))
    return _refused(robot, reasons) if reasons else None


def _refused(robot: str, reasons: list[tuple[str, str]]) -> Outcome:
    return Outcome(
        robot,
        Result.REFUSED,
        "; ".join(reason for reason, _ in reasons),
        hint="; ".join(dict.fromkeys(hint for _, hint in reasons if hint)),
    )


def deploy(host: Host, robot: str, computer: Computer, order: Order) -> Outcome:
    """Bring one robot to its bundle. Raises NodeError where it fails before anything that runs was touched."""
    order.tell(robot, "look")
    facts = probe(host, computer.python)
    refused = refusal(order, robot, computer, facts)
    if refused is not None:
        return refused
    try:
        release = wanted(order, robot, facts)
    except InputError as error:
        return Outcome(robot, Result.REFUSED, str(error), hint=error.hint)
    if facts.current == release.id and facts.is_sound:
        return Outcome(robot, Result.UNCHANGED, f"already runs {release.id}", facts={"release": release.id})
    if order.only_configuration and not _only_configuration(facts, release):
        return _refused(robot, [_more_than_configuration(facts, release)])
    sent = 0
    if release.id not in facts.releases or facts.damaged:
        needed = release.unpacked_bytes if release.tree not in facts.trees or facts.damaged else 0
        full = list(room_objection(facts, needed))
        if full:
            return _refused(robot, full)
        if needed:
            order.tell(robot, f"send {sum(len(wheel.content) for wheel in release.wheels) >> 10} KiB of packages")
            for wheel in release.wheels:
                sent += host.put(wheel.content, f"{_WHEEL_DIRECTORY}/{wheel.file}")
        order.tell(robot, f"install {release.id}")
        host.run("install", release.id, release.tree, stdin=release.archive(), timeout_s=INSTALL_TIMEOUT_S)
    how = "reload" if _only_configuration(facts, release) else "restart"
    order.tell(robot, f"switch to {release.id} ({how})")
    outcome = switch(host, robot, release.id, how, order.wait_s)
    return Outcome(
        outcome.node,
        outcome.result,
        outcome.reason,
        outcome.hint,
        facts={**outcome.facts, "release": release.id, "how": how, "sent_bytes": str(sent)},
    )


def _only_configuration(facts: Facts, release: Bundle) -> bool:
    """Whether the running daemon can take the new release by reading its files again, losing nothing it holds."""
    changed = changed_files(facts, release.hashes)
    return facts.is_sound and all(path.startswith("etc/") or path == "topics" for path in changed)


def _more_than_configuration(facts: Facts, release: Bundle) -> tuple[str, str]:
    if not facts.current:
        return "udp_mesh is not installed there", "`meshctl robots deploy` first"
    if not facts.is_sound:
        return "the daemon there does not run as it was deployed", "`meshctl robots diff`, then `meshctl robots deploy`"
    other = [path for path in changed_files(facts, release.hashes) if not path.startswith("etc/") and path != "topics"]
    return f"more than the configuration would change ({', '.join(other)})", "`meshctl robots deploy` first"


def switch(host: Host, robot: str, release: str, how: str, wait_s: int) -> Outcome:
    """Make an installed release the current one, or stay with the one before."""
    try:
        told = host.run("switch", release, how, str(wait_s), timeout_s=2 * wait_s + _RESTARTS_S)
    except (Timeout, ConnectionLost) as error:
        hint = "the robot finishes or undoes the switch by itself; deploy again to see which"
        return Outcome(robot, Result.UNCERTAIN, f"{error}", hint=hint)
    return switched(robot, release, told)


def switched(robot: str, release: str, told: str) -> Outcome:
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
            why = f"{reason}; went back to the release before, which does not prove itself either"
            return Outcome(robot, Result.ROLLED_BACK, why, hint)
        case "removed":
            return Outcome(robot, Result.ROLLED_BACK, f"{reason}; there was no release before, so it was removed", hint)
        case _:
            return Outcome(robot, Result.FAILED, f"{reason or 'the switch said nothing'}; nothing to go back to", hint)


def roll_back(host: Host, robot: str, computer: Computer, wait_s: int) -> Outcome:
    """Go back to the release before, which stays installed for this."""
    facts = probe(host, computer.python)
    if not facts.previous or facts.previous not in facts.releases:
        raise Refused(f"{host.label}: there is no release before {facts.current or 'this'}", code="no-release")
    return switch(host, robot, facts.previous, "restart", wait_s)
