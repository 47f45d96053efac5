"""The steps of a change on one node; each may be repeated after its connection was cut.

`send` (one command), or `arm` (install the dead-man's switch, lock, stage, arm) and `start`, use the existing
connection. After that the node is observed over new ones until its services have reloaded, then over one opened after
that (`connect`, `observe_and_decide`), and `confirm` or `abort` ends the change.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

from meshctl.apply.change_listener import ChangeListener
from meshctl.apply.change_set import change_of, new_change_id, new_nonce, radios_of, services_of
from meshctl.apply.context import NodeContext
from meshctl.apply.first_boot import await_first_boot
from meshctl.apply.health_checks import RELOADING, unmet
from meshctl.apply.next_action import Action, applied_age_s, next_action
from meshctl.deadline import deadline
from meshctl.device import deadman
from meshctl.device.connection import Deadlines, Endpoint
from meshctl.device.deadman import Change, Payload
from meshctl.device.errors import AuthenticationRefused, CommandFailed, NodeRefused
from meshctl.device.observation import ChangeStatus, Observation
from meshctl.device.observe import observe
from meshctl.device.ssh import SshConnection
from meshctl.device.upload import UploadProgress
from meshctl.errors import NodeError
from meshctl.model import Secret
from meshctl.nodes.slots import Slot
from meshctl.plan import Cut
from meshctl.plan.effects import loaded_package
from meshctl.plan.observed_files import WIRELESS
from meshctl.plan.radios import NO_RADIOS, Radios
from meshctl.render.rendered import MARKER_PATH

LOCK_SLACK_S = 60  # the lock outlives the confirm window by this much, for the actions after it
# The first look at a node whose connection the change has cut: before, its services cannot have reloaded, because procd
# collects events for 1 s, and a login would slow them down. Not a settling time: the reload's end is observed.
FIRST_LOOK_S = 3.0
PACKAGES_SETTLE_S = 3.0  # the reload of a package change sends its events and does not wait for them
# The change starts after this delay, so that the answer to `apply` arrives before the connection may be cut.
APPLY_DELAY_S, APPLY_ANSWER_TIMEOUT_S = 0.5, 15.0
# How long a node that keeps its address is waited for over the connection that sent the change.
AWAIT_RELOAD_S = 30
# How long a look waits on the node for that: a login takes a slow node about as long.
LOOK_AWAITS_S = 5
# A rollback restores the files and reloads the services, which takes a board some 10 s.
ROLLBACK_S = 30.0
# The UCI packages with which a node may drop a login without an answer; with others it refuses it.
_MAY_DROP_LOGINS = frozenset({"firewall", "network"})
# A login at an address other than the new one may hang: another device may have that address, or the server may be
# going down. While the confirm window runs, each phase of such a login takes at most this share of it.
ELSEWHERE_SHARE = 1 / 16
ABSENT = ChangeStatus("absent", installed=False)


@dataclass(slots=True)
class ChangeInProgress:
    """A change and its progress. The node answers at `old` before the change and at `new` after it: the first of
    `candidates`, unless it was `found_at` another. `unmet` lists the health checks that failed in the latest
    observation (`last`); `last_error` is why there was none."""

    ctx: NodeContext
    payload: Change
    nonce: Secret
    window_s: int
    old: Endpoint
    candidates: tuple[Endpoint, ...]
    starts: int = 0
    unmet: tuple[str, ...] = ()
    last: Observation | None = None
    last_error: str = ""
    # since the change was last observed as applied: the refused login, and why the node was unreachable
    login_refused: str = ""
    connect_error: str = ""
    is_abandoned: bool = False  # from now on the change is only ever aborted
    # a confirmation was sent, and the node has not answered: it may have kept the change
    is_confirm_unanswered: bool = False
    extra_s: float = 0.0  # how long its `extra` script may take before the confirm window starts
    armed_in_s: float = 0.0  # how long its node took to arm it: a start takes about as long
    held_s: float = 0.0  # how long it may wait for other nodes to be armed, before it starts
    # uploads again what that script reads from the node's memory, which a reboot has emptied
    upload_again: Callable[[SshConnection], object] | None = None
    radios: Radios = NO_RADIOS
    started_s: float | None = None  # by the monotonic clock; in the future if it was scheduled
    found_at: Endpoint | None = None  # the one of `candidates` where the node answered
    # whether its services have reloaded: only a connection opened after that proves the node reachable
    is_reloaded: bool = False
    listener: ChangeListener = field(init=False, repr=False)
    sent: Payload = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.listener = self.ctx.run.new_listener(self.ctx, self.radios)
        self.sent = Payload.of(self.payload)

    @property
    def new(self) -> Endpoint:
        return self.found_at or self.candidates[0]

    @property
    def id(self) -> str:
        return self.payload.change_id

    @property
    def status(self) -> ChangeStatus:
        """The state of the dead-man's switch in the latest observation."""
        return ABSENT if self.last is None else self.last.change or ABSENT

    @property
    def decides_logins(self) -> bool:
        """Whether it may affect who can log in: all but settings of radios, which only decide over which links."""
        harmless = (WIRELESS, MARKER_PATH)
        return self.extra_s > 0 or any(change.path not in harmless for change in self.ctx.plan.files)

    @property
    def starts_in_s(self) -> float:
        """How long it is until a scheduled change starts."""
        return 0.0 if self.started_s is None else max(0.0, self.started_s - time.monotonic())

    @property
    def is_window_over(self) -> bool:
        """Whether the node has confirmed it or rolled it back by now."""
        return self.started_s is None or time.monotonic() - self.started_s > self.extra_s + self.window_s

    @property
    def is_undone(self) -> bool:
        """Whether its timer has rolled it back and reloaded the services by now, unless it was confirmed."""
        limit_s = self.extra_s + self.window_s + ROLLBACK_S
        return self.started_s is not None and time.monotonic() - self.started_s > limit_s

    @property
    def is_login_due(self) -> bool:
        """Whether its SSH server has to answer, if only by a refusal: the change has not started, cannot drop logins,
        or was undone by its timer."""
        touched = () if self.started_s is None else (*self.payload.files, *self.payload.removed)
        return self.is_undone or not any(loaded_package(path.lstrip("/")) in _MAY_DROP_LOGINS for path in touched)

    @property
    def first_look_s(self) -> float:
        """How long after its start the node is first looked at."""
        return FIRST_LOOK_S if self.ctx.plan.cut > Cut.LOGIN else 0.0


def new_change(ctx: NodeContext, old: Endpoint, *, window_s: int | None = None) -> ChangeInProgress:
    """A new change for a node that answers at `old` now."""
    services = services_of(ctx.run.fleet, ctx.node)
    return ChangeInProgress(
        ctx,
        change_of(new_change_id(), ctx.plan, ctx.desired, ctx.before, services),
        new_nonce(),
        window_s or ctx.node.confirm_window_s,
        old,
        ctx.run.connections.candidates(ctx.node),
        radios=radios_of(ctx.plan, ctx.desired, ctx.before),
    )


def arm(change: ChangeInProgress, connection: SshConnection) -> None:
    """Upload the change and arm it; no file has changed yet. Raises NodeRefused, NodeError."""
    ctx, owner = change.ctx, change.ctx.run.owner
    change.starts += 1
    await_first_boot(ctx, connection)
    with ctx.step("stage"):
        install_switch(ctx, connection)
        deadman.lock(connection, owner, ttl_s=change.window_s + LOCK_SLACK_S + math.ceil(change.held_s))
        rate = ctx.run.rate_bytes_per_s
        deadman.stage(connection, owner, change.payload, rate_bytes_per_s=rate, progress=ctx.progress)
    with ctx.step("arm"):
        began_s = time.monotonic()
        deadman.arm(connection, owner, change.id, nonce=change.nonce, window_s=change.window_s)
        change.armed_in_s = time.monotonic() - began_s


def install_switch(ctx: NodeContext, connection: SshConnection) -> None:
    """Install the dead-man's switch unless the node has this version."""
    known = ctx.before.change
    if known is None or not known.installed or known.version != deadman.version():
        deadman.install(connection)


def is_one_command(change: ChangeInProgress) -> bool:
    """Whether the change is sent, armed and started by one command: it is small, and nothing limits its rate."""
    return change.ctx.run.rate_bytes_per_s is None and not change.extra_s and change.sent.fits_one_command


def send(change: ChangeInProgress, connection: SshConnection, slot: Slot) -> None:
    """Upload, arm and start the change, and wait on the node until its services have reloaded. Raises NodeRefused,
    NodeError, and Unreachable if the change cuts the connection.

    The slot is given back as soon as the bundle is sent. A node that changes its address is not waited for.
    """
    ctx = change.ctx
    change.starts += 1
    await_first_boot(ctx, connection)
    with ctx.step("apply"):
        install_switch(ctx, connection)
        change.listener.started()
        change.started_s = time.monotonic()
        await_reload_s = AWAIT_RELOAD_S if connection.endpoint.host == change.new.host else 0
        with change.listener.waiting(connection):
            status = deadman.change(
                connection,
                ctx.run.owner,
                change.sent,
                nonce=change.nonce,
                window_s=change.window_s,
                ttl_s=change.window_s + LOCK_SLACK_S,
                await_reload_s=min(await_reload_s, change.window_s // 2),
                sent=slot.release,
            )
    size = len(change.sent.content)
    ctx.progress(UploadProgress(size, size))
    change.is_reloaded = status is not None


def start(
    change: ChangeInProgress, connection: SshConnection, *, at_uptime_s: float | None = None, due_s: float | None = None
) -> None:
    """Start the change: in a moment, or when the node's uptime reaches `at_uptime_s`, which is `due_s` by the monotonic
    clock.

    The change may cut this connection while its confirm window runs, so the wait for the answer is short. Raises
    NodeRefused, Unreachable.
    """
    change.listener.started()
    change.started_s = time.monotonic() if due_s is None else due_s
    change.is_reloaded = False
    in_s = None if at_uptime_s is not None else APPLY_DELAY_S
    with (
        deadline(min(APPLY_ANSWER_TIMEOUT_S, change.window_s / 4), connection.close),
        change.ctx.step("apply"),
    ):
        deadman.apply(connection, change.ctx.run.owner, change.id, in_s=in_s, at_uptime_s=at_uptime_s)


def connect(change: ChangeInProgress) -> SshConnection | None:
    """A new connection to the node's new address, or else to its old one."""
    ctx = change.ctx
    for endpoint in dict.fromkeys((change.new, *change.candidates, change.old)):
        try:
            connection = ctx.run.connections.open(ctx.node, endpoint=endpoint, deadlines=_deadlines(change, endpoint))
        except NodeError as error:
            change.last_error = str(error)
            # what a login meets while its timer rolls it back is not why it does
            if change.started_s is None or not change.is_window_over:
                change.connect_error = change.last_error
                change.login_refused = str(error) if isinstance(error, AuthenticationRefused) else change.login_refused
            continue
        if endpoint in change.candidates:
            change.found_at = endpoint
        return connection
    return None


def _deadlines(change: ChangeInProgress, endpoint: Endpoint) -> Deadlines:
    usual = change.ctx.run.connections.deadlines
    if endpoint == change.new or change.is_window_over:
        return usual
    limit_s = change.window_s * ELSEWHERE_SHARE
    return replace(
        usual,
        connect_s=min(usual.connect_s, limit_s),
        handshake_s=min(usual.handshake_s, limit_s),
        auth_s=min(usual.auth_s, limit_s),
    )


def observe_and_decide(
    change: ChangeInProgress,
    connection: SshConnection,
    *,
    is_opened_after_reload: bool = False,
    slot: Slot | None = None,
) -> Action:
    """Observe the node once and return the next action. `is_opened_after_reload`: the services are known to have
    reloaded before the connection was opened. The slot is given back while the node is waited for. Raises
    Unreachable."""
    ctx = change.ctx
    if not is_opened_after_reload:
        busy = _while_it_reloads(change, connection, slot)
        if busy is not None:
            return busy
    change.last = observe(connection, brief=True)
    age_s = applied_age_s(change.status)
    if age_s is not None:
        change.login_refused = change.connect_error = ""
        change.listener.observed()
    # what is missing after the rollback is not why the node rolled back
    if change.status.state == "applied":
        change.unmet = unmet(
            ctx.expected.with_base_macs(ctx.run.current_base_macs(ctx.node)), change.last, since_s=age_s
        )
    if change.extra_s and age_s is not None and age_s < PACKAGES_SETTLE_S:
        change.unmet = (*change.unmet, "its services may still be reloading")
    return next_action(
        change.id,
        change.status,
        change.unmet,
        is_at_new_address=connection.endpoint == change.new,
        leaving=ctx.run.interrupt.leaving,
        is_abandoned=change.is_abandoned,
    )


def _while_it_reloads(change: ChangeInProgress, connection: SshConnection, slot: Slot | None) -> Action | None:
    """The next action while the node's services reload, or when they just have; None when it is time for a full
    observation.

    A full observation would slow the reload on a small processor, as further logins would, and break when the radio
    goes down. Raises Unreachable.
    """
    is_over = change.is_reloaded or change.is_abandoned or change.ctx.run.interrupt.leaving
    await_s = 0 if is_over else min(LOOK_AWAITS_S, change.window_s // 8)
    if slot is not None and await_s:
        slot.release()
    try:
        status = deadman.status(connection, started=change.id, await_reload_s=await_s)
    except CommandFailed:
        # the observation reports the fault
        return None
    if status.change_id != change.id or status.state not in ("waiting", "applied"):
        return None
    if status.reload_status is not None:
        if change.is_reloaded or status.state != "applied":
            return None
        # this connection may have been accepted before the change took effect
        change.is_reloaded = True
    if status.state == "applied":
        change.login_refused = change.connect_error = ""
        change.listener.observed()
    change.unmet = (RELOADING,)
    return next_action(
        change.id,
        status,
        change.unmet,
        is_at_new_address=False,
        leaving=change.ctx.run.interrupt.leaving,
        is_abandoned=change.is_abandoned,
    )


def confirm(change: ChangeInProgress, proof: SshConnection | None = None) -> bool:
    """Confirm over a connection that was opened after the services had reloaded: that login is the proof that the node
    is reachable. `proof` is such a connection; otherwise a new one is opened, and goes to the pool.

    False if the window expired meanwhile. Raises Unreachable.
    """
    if proof is not None:
        return _confirm_over(change, proof)
    ctx = change.ctx
    connection = ctx.run.connections.open(ctx.node, endpoint=change.new)
    try:
        is_confirmed = _confirm_over(change, connection)
    except BaseException:
        connection.close()
        raise
    if is_confirmed:
        ctx.run.connections.release(ctx.name, connection)
    else:
        connection.close()
    return is_confirmed


def _confirm_over(change: ChangeInProgress, connection: SshConnection) -> bool:
    change.is_confirm_unanswered = True
    is_confirmed = False
    with suppress(NodeRefused):
        deadman.confirm(connection, change.id, nonce=change.nonce, owner=change.ctx.run.owner)
        is_confirmed = True
    change.is_confirm_unanswered = False
    return is_confirmed


def unlock(change: ChangeInProgress, connection: SshConnection) -> None:
    """Release the lock. A failure does not change the outcome: the lock expires by itself."""
    with suppress(NodeError):
        deadman.unlock(connection, change.ctx.run.owner)


def abort(change: ChangeInProgress, connection: SshConnection) -> None:
    """Roll the change back now. If the node refuses, its next status shows why."""
    with suppress(NodeRefused):
        deadman.abort(connection, change.ctx.run.owner, change.id)
