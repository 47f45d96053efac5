"""Fault injection: apply the faults of `faults` to a running fleet, and repair them."""

from __future__ import annotations

import asyncio
import os
import shlex
from typing import assert_never

from meshctl.errors import InputError
from meshlab.container import write_meminfo
from meshlab.errors import LabError
from meshlab.faults import LINK_FAULTS, SLOW_DELAY_MS, SLOW_LOSS, SLOW_RATE_KBPS, Fault, FaultRequest, parse
from meshlab.fleet_state import FleetState, NodeControl
from meshlab.link_state import LinkState
from meshlab.state import NodeState, Power, write_firmware

_FREE_FLASH_KIB = 8
_FREE_MEMORY_KIB = 2048
_TEN_YEARS_S = 10 * 365 * 86400
# fillers are plain files, so that `du` on the node shows what uses the space
_FILLERS = ("/root/lab-filler", "/tmp/lab-filler")
# polling commands: counting them would make step numbers depend on the host's speed
_UNCOUNTED = ("sleep", "ash", "sh", "busybox")
_SLOW = {"delay_ms": SLOW_DELAY_MS, "loss": SLOW_LOSS, "rate_kbps": SLOW_RATE_KBPS}


class FaultInjection:
    """Raises InputError for an unknown node, link or fault, LabError when the node cannot take the fault now."""

    def __init__(self, fleet: FleetState, link_state: LinkState, control: NodeControl) -> None:
        self._fleet = fleet
        self._link_state = link_state
        self._control = control

    def _link_ends(self, where: str) -> tuple[str, str] | None:
        """`b01-b02` as two nodes; None when it names a node. Node names may contain dashes."""
        if where in self._fleet.nodes:
            return None
        for place in (at for at, char in enumerate(where) if char == "-"):
            a, b = where[:place], where[place + 1 :]
            if a in self._fleet.nodes and b in self._fleet.nodes:
                return a, b
        self._fleet.node(where)
        return None

    async def inject(self, where: str, what: str) -> None:
        """Inject a fault into a node or a link: `meshctl lab break WHERE WHAT`."""
        request = parse(what)
        link = self._link_ends(where)
        if link is not None:
            if request.fault not in LINK_FAULTS:
                raise InputError(
                    f"{request.fault.value} is for nodes; links take {', '.join(fault.value for fault in LINK_FAULTS)}"
                )
            self._link_state.set_link(*link, {"up": False} if request.fault is Fault.LINK_DOWN else dict(_SLOW))
            return
        state = self._fleet.node(where)
        if what not in state.faults:
            state.faults.append(what)
        await self._inject_node(state, request)

    async def _inject_node(self, state: NodeState, request: FaultRequest) -> None:
        name = state.spec.name
        match request.fault:
            case Fault.CUT if request.step == "flash":
                state.cut_at_flash = True
            case Fault.CUT if request.step:
                await self.count_steps(state, fatal=f"cut {request.step}")
            case Fault.CUT:
                await self.power_cut(state, "lost", back=True)
            case Fault.CUT_KEPT:
                await self.power_cut(state, "kept", back=True)
            case Fault.CUT_TORN:
                await self.power_cut(state, "torn", back=True)
            case Fault.OFF:
                await self.power_cut(state, "lost", back=False)
            case Fault.SEVER if request.step:
                await self.count_steps(state, fatal=f"sever {request.step}")
            case Fault.SEVER | Fault.LINK_DOWN:
                self._cut_links(state)
            case Fault.SLOW:
                self._link_state.slowed[name] = dict(_SLOW)
                self._link_state.changed()
            case Fault.FULL_FLASH:
                await self._fill(state, _FILLERS[0], "/overlay", _FREE_FLASH_KIB)
            case Fault.FULL_MEMORY:
                write_meminfo(self._fleet.container(state), available_kib=_FREE_MEMORY_KIB)
                await self._fill(state, _FILLERS[1], "/tmp", 0)
            case Fault.WRONG_BOARD:
                state.wrong_board = True
                await self.run(state, "echo virtual,other-board >/tmp/sysinfo/board_name", may_be_off=True)
            case Fault.HOST_KEY:
                await self.run(state, "rm -f /etc/dropbear/*_host_key && sync && /etc/init.d/dropbear restart")
            case Fault.FOREIGN_DELTA:
                await self.run(state, "uci set system.@system[0].description='left by hand'")
            case Fault.CLOCK:
                (state.home / "clock").write_text(f"-{_TEN_YEARS_S}\n", encoding="ascii")
            case Fault.SSH_HANG:
                state.hung = True
                self._link_state.changed()
            case _:
                assert_never(request.what)

    async def repair(self, where: str) -> None:
        """Repair one node or link, or all; a node whose firmware is dead gets its factory image."""
        link = self._link_ends(where) if where else None
        if link is not None:
            self._link_state.restore(frozenset(link))
            return
        if not where:
            self._link_state.restore()
        for state in [self._fleet.node(where)] if where else list(self._fleet.nodes.values()):
            await self._repair_node(state)

    async def _repair_node(self, state: NodeState) -> None:
        name = state.spec.name
        state.faults.clear()
        # a cable that was plugged in meanwhile stays
        state.plugged |= self._link_state.severed.pop(name, False)
        self._link_state.slowed.pop(name, None)
        state.hung = state.cut_at_flash = state.wrong_board = False
        (state.home / "clock").unlink(missing_ok=True)
        if state.is_running:
            write_meminfo(self._fleet.container(state), available_kib=state.spec.memory_kib * 3 // 5)
            board = shlex.quote(state.spec.board)
            # sync only where the flash was filled: a repair must not persist other unsynced changes
            await self.run(
                state,
                f"PATH=/bin:/sbin; rm -f {_FILLERS[1]} /tmp/lab/fatal; uci -q revert system; "
                f"[ ! -e {_FILLERS[0]} ] || {{ rm -f {_FILLERS[0]}; sync; }}; echo {board} >/tmp/sysinfo/board_name",
            )
        elif state.power is Power.DEAD:
            # as TFTP recovery at the bench would
            write_firmware(state.home, state.spec.release, state.spec.packages, state.spec.target)
            (state.home / "flash" / "current").unlink(missing_ok=True)
            state.power = Power.OFF
        self._control.power_on(name)
        self._link_state.changed()

    # -- power --

    async def power_cut(self, state: NodeState, unsynced: str, *, back: bool) -> None:
        """Cut the power; unsynced data is `lost`, `kept` or `torn`."""
        if unsynced == "kept":
            await self.run(state, "sync", may_be_off=True)
        elif unsynced == "torn":
            await self.run(state, "sh /rom/lab/tear", may_be_off=True)
        elif unsynced != "lost":
            raise InputError(f"unsynced: expected lost, kept or torn, found {unsynced!r}")
        self._control.power_off(state.spec.name, back=back)

    def sever(self, state: NodeState) -> None:
        """The node reached the step at which its links go down, and waits for `go`."""
        self._cut_links(state)
        try:
            go = os.open(f"/proc/{state.pid}/root/tmp/lab/go", os.O_RDWR | os.O_NONBLOCK)
        except OSError:
            return
        os.write(go, b"go\n")
        os.close(go)

    def _cut_links(self, state: NodeState) -> None:
        self._link_state.severed.setdefault(state.spec.name, state.plugged)
        state.plugged = False
        self._link_state.changed()

    # -- on the node --

    async def count_steps(self, state: NodeState, *, fatal: str = "") -> None:
        """Count the node's external commands from now on; `fatal` is `cut N`, `cut TEXT`, `sever N` or empty."""
        skipped = " ".join(_UNCOUNTED)
        await self.run(
            state,
            f"""
            PATH=/bin:/sbin
            rm -rf /tmp/lab/steps.log /tmp/lab/fatal /tmp/lab/struck /tmp/lab/go
            mkfifo /tmp/lab/go
            : >/tmp/lab/steps.log
            [ -z {shlex.quote(fatal)} ] || echo {shlex.quote(fatal)} >/tmp/lab/fatal
            for path in /bin/* /sbin/*; do
                name=${{path##*/}}
                case " {skipped} " in *" $name "*) ;; *) ln -sf /rom/lab/step "/usr/sbin/$name" ;; esac
            done""",
        )

    async def _fill(self, state: NodeState, file: str, place: str, free_kib: int) -> None:
        await self.run(
            state,
            f"free=$(df -k {place} | awk 'NR == 2 {{ print $4 }}'); "
            f"dd if=/dev/zero of={file} bs=1k count=$((free - {free_kib})) 2>/dev/null; true",
        )

    async def run(self, state: NodeState, command: str, *, may_be_off: bool = False) -> None:
        """Run a command on the node. Raises LabError when the node is off or the command fails."""
        null = os.open("/dev/null", os.O_RDWR | os.O_CLOEXEC)
        output, output_end = os.pipe2(os.O_CLOEXEC)
        try:
            request = {"do": "exec", "node": state.spec.name, "command": command}
            event, _ = await self._control.request(request, (null, null, output_end))
            os.close(output_end)
            output_end = -1
            os.set_blocking(output, False)
            try:
                message = os.read(output, 4096).decode("utf-8", "replace").strip()
            except BlockingIOError:
                message = ""
        finally:
            for descriptor in (null, output, output_end):
                if descriptor >= 0:
                    os.close(descriptor)
        if event["status"] != 0 and not (may_be_off and event.get("reason")):
            raise LabError(f"{state.spec.name}: {event.get('reason') or message or 'the command failed'}")
        await asyncio.sleep(0)
