"""A change under way on one node: sending it, beginning it, finding the node again, looking, confirming.

`prepare` (install the switch, lock, stage, arm) and `begin` go over the connection at hand; from then on each look is
over a new connection (`reach`, `look`), and `confirm` opens one of its own. Each verb may be repeated after a cut.
"""

from __future__ import annotations

import re
import threading
from contextlib import suppress
from dataclasses import dataclass, field

from meshctl.apply.change_set import change_of, new_change_id, new_nonce, services_of
from meshctl.apply.context import Job
from meshctl.apply.health_checks import RELOADING, missing
from meshctl.apply.next_action import Move, applied_age_s, next_move
from meshctl.apply.station_flush import Forgetting
from meshctl.device import deadman
from meshctl.device.connection import Endpoint
from meshctl.device.deadman import Change
from meshctl.device.errors import AuthenticationRefused, CommandFailed, NodeRefused
from meshctl.device.observation import ChangeStatus, Observation
from meshctl.device.observe import observe
from meshctl.device.openwrt import root_in_ram
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError
from meshctl.model import Secret
from meshctl.nodes.backoff import Pace
from meshctl.plan import Cut
from meshctl.plan.radios import NO_RADIOS, Radios, restarted
from meshctl.plan.seen import WIRELESS, packages_seen

# A lock outlives its change by this much, for the moves after it.
LOCK_SLACK_S = 60
# reload_config returns before netifd has begun: procd gathers events for 1 s, then interfaces go down and come up.
SETTLE_S = 3.0
# The answer to `apply` has to be out before the change cuts the connection; one that is late is not waited for long.
ANSWER_FIRST_S, ANSWER_S = 0.5, 15.0
# Erasing 16 MB of NOR takes up to three minutes, more with other work beside it.
FLASH_READY_S = 600.0
ABSENT = ChangeStatus("absent", installed=False)


@dataclass(slots=True)
class Attempt:
    """One change. `old` is where the node answers before it, `new` where it shall answer after it: the first of
    `places`, until it was `met` at another. `gaps` is what was still missing when the node was last seen (`last`),
    `trouble` why it was not."""

    job: Job
    change: Change
    nonce: Secret
    window_s: int
    old: Endpoint
    places: tuple[Endpoint, ...]
    starts: int = 0
    gaps: tuple[str, ...] = ()
    last: Observation | None = None
    trouble: str = ""
    # that it let nobody in, since it was last seen with the change in force
    shut_out: str = ""
    # why it could not be reached, since it was last seen with the change in force
    unreached: str = ""
    # decided against: from now on it is only ever taken back
    is_given_up: bool = False
    # what it does besides files may take so long before its window begins
    extra_s: float = 0.0
    # those that start anew with it
    radios: Radios = NO_RADIOS
    # the one of `places` where it was met
    met: Endpoint | None = None
    # whether its services have taken up the change: only a connection opened after that proves anything
    is_reloaded: bool = False
    forgetting: Forgetting = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.forgetting = Forgetting(self.job, self.radios)

    @property
    def new(self) -> Endpoint:
        return self.met or self.places[0]

    @property
    def id(self) -> str:
        return self.change.change_id

    @property
    def status(self) -> ChangeStatus:
        """What the node's switch said when it was last seen."""
        return ABSENT if self.last is None else self.last.change or ABSENT

    @property
    def settle_s(self) -> float:
        """How long the change has to stand before what is seen counts as its effect."""
        return SETTLE_S if self.job.plan.cut > Cut.LOGIN else 0.0


def attempt_of(job: Job, old: Endpoint, *, window_s: int | None = None) -> Attempt:
    """A new change for a node that is reached at `old` now."""
    services = services_of(job.work.fleet, job.node)
    return Attempt(
        job,
        change_of(new_change_id(), job.plan, job.wanted, job.before, services),
        new_nonce(),
        window_s or job.node.confirm_window_s,
        old,
        job.work.access.places(job.node),
        radios=_radios_of(job),
    )


def _radios_of(job: Job) -> Radios:
    """Which of the node's radios start anew with its plan's files."""
    if not any(change.path == WIRELESS for change in job.plan.files):
        return NO_RADIOS
    before = packages_seen([WIRELESS], job.before)["wireless"]
    return restarted(before, next((file.package for file in job.wanted.files if file.path == WIRELESS), None))


def prepare(attempt: Attempt, connection: SshConnection) -> None:
    """Bring the change there and arm it; nothing it touches has changed yet. Raises NodeRefused, NodeError."""
    job, owner = attempt.job, attempt.job.work.owner
    attempt.starts += 1
    await_flash(job, connection)
    with job.step("stage"):
        install_switch(job, connection)
        deadman.lock(connection, owner, ttl_s=attempt.window_s + LOCK_SLACK_S)
        deadman.stage(
            connection, owner, attempt.change, rate_bytes_per_s=job.work.rate_bytes_per_s, progress=job.progress
        )
    with job.step("arm"):
        deadman.arm(connection, owner, attempt.id, nonce=attempt.nonce, window_s=attempt.window_s)


def await_flash(job: Job, connection: SshConnection) -> None:
    """Wait until / is in flash: at its first boot a node is in memory until its flash is formatted, and what is written
    until then may be lost. Raises NodeError when that does not come to pass."""
    if not job.before.root_in_ram or not root_in_ram(connection):
        return
    job.work.note("its flash is not ready yet (first boot): waiting", job.name)
    pace = Pace(FLASH_READY_S, job.work.interrupt)
    with job.step("flash ready"):
        while root_in_ram(connection):
            if pace.is_over or job.work.interrupt.leaving:
                raise NodeError(
                    f"{job.name}: its flash was not ready within {FLASH_READY_S / 60:.0f} minutes; nothing was changed",
                    hint="switch it off and on, then run again",
                )
            pace.pause()


def install_switch(job: Job, connection: SshConnection) -> None:
    """Put the switch there unless this very version already is."""
    known = job.before.change
    own = re.search(rb"^VERSION=(\S+)", deadman.installed_files()[deadman.PROGRAM][1], re.MULTILINE)
    if known is None or not known.installed or own is None or known.version != own[1].decode():
        deadman.install(connection)


def begin(attempt: Attempt, connection: SshConnection, *, at_uptime_s: float | None = None) -> None:
    """Have the node begin: in a moment, or when its own uptime reaches `at_uptime_s`.

    The change may cut this very connection, so an answer that does not come soon is not waited for: the window is
    running. Raises NodeRefused, Unreachable.
    """
    attempt.forgetting.begins()
    patience = threading.Timer(min(ANSWER_S, attempt.window_s / 4), connection.close)
    patience.daemon = True
    patience.start()
    in_s = None if at_uptime_s is not None else ANSWER_FIRST_S
    try:
        with attempt.job.step("apply"):
            deadman.apply(connection, attempt.job.work.owner, attempt.id, in_s=in_s, at_uptime_s=at_uptime_s)
    finally:
        patience.cancel()


def reach(attempt: Attempt) -> SshConnection | None:
    """A new connection to where the node shall be, or else to where it was."""
    job = attempt.job
    for endpoint in dict.fromkeys((attempt.new, *attempt.places, attempt.old)):
        try:
            connection = job.work.access.open(job.node, endpoint=endpoint)
        except NodeError as error:
            attempt.trouble = attempt.unreached = str(error)
            if isinstance(error, AuthenticationRefused):
                attempt.shut_out = attempt.trouble
            continue
        if endpoint in attempt.places:
            attempt.met = endpoint
        return connection
    return None


def look(attempt: Attempt, connection: SshConnection) -> Move:
    """Observe the node once and say what is next. Raises Unreachable."""
    job = attempt.job
    busy = _while_it_reloads(attempt, connection)
    if busy is not None:
        return busy
    attempt.last = observe(connection)
    age_s = applied_age_s(attempt.status)
    if age_s is not None:
        attempt.shut_out = attempt.unreached = ""
        attempt.forgetting.stands()
    attempt.gaps = missing(job.expected.with_bases(job.work.current_bases()), attempt.last, since_s=age_s)
    if age_s is not None and age_s < attempt.settle_s:
        attempt.gaps = (*attempt.gaps, "it has not settled yet")
    return next_move(
        attempt.id,
        attempt.status,
        attempt.gaps,
        is_at_new_address=connection.endpoint == attempt.new,
        leaving=job.work.interrupt.leaving,
        is_given_up=attempt.is_given_up,
    )


def _while_it_reloads(attempt: Attempt, connection: SshConnection) -> Move | None:
    """What is next as long as the node's services take up the change; None when it is time to look at everything.

    That would hold them up on a small processor, and be cut short when they take the radio down. Raises Unreachable.
    """
    try:
        status = deadman.status(connection)
    except CommandFailed:
        # what is wrong there the observation tells
        return None
    if status.change_id != attempt.id or status.state not in ("waiting", "applied"):
        return None
    if status.reload_status is not None:
        if attempt.is_reloaded or status.state != "applied":
            return None
        # this very connection may have been let in before the effects were in force
        attempt.is_reloaded = True
    if status.state == "applied":
        attempt.shut_out = attempt.unreached = ""
        attempt.forgetting.stands()
    attempt.gaps = (RELOADING,)
    leaving = attempt.job.work.interrupt.leaving
    return next_move(
        attempt.id,
        status,
        attempt.gaps,
        is_at_new_address=False,
        leaving=leaving,
        is_given_up=attempt.is_given_up,
    )


def confirm(attempt: Attempt) -> bool:
    """Confirm over a connection opened only now: that it lets us in after the change is the proof.

    False when the window had run out on the way. Raises Unreachable.
    """
    job = attempt.job
    connection = job.work.access.open(job.node, endpoint=attempt.new)
    try:
        deadman.confirm(connection, attempt.id, nonce=attempt.nonce)
        release(attempt, connection)
    except NodeRefused:
        connection.close()
        return False
    except BaseException:
        connection.close()
        raise
    job.work.access.keep(job.name, connection)
    return True


def release(attempt: Attempt, connection: SshConnection) -> None:
    """Give the lock back; that it cannot be (it runs out by itself) changes nothing about the outcome."""
    with suppress(NodeError):
        deadman.unlock(connection, attempt.job.work.owner)


def take_back(attempt: Attempt, connection: SshConnection) -> None:
    """Have the node undo the change now. What the node refuses it will tell in its next status."""
    with suppress(NodeRefused):
        deadman.abort(connection, attempt.job.work.owner, attempt.id)
