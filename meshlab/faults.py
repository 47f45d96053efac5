"""The faults that `meshctl lab break WHERE WHAT` injects, and the parser of WHAT.

WHERE is a node or a link (`b01-b02`). WHAT is one of `FAULTS`, some with `@STEP`: the n-th external command the node
runs from now on, the first command that contains a text (`power-cut@uci commit`), or `flash` for the middle of a flash.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from meshctl.errors import InputError


class Fault(Enum):
    """The value is the name on the command line."""

    CUT = "power-cut"
    CUT_KEPT = "power-cut-kept"
    CUT_TORN = "power-cut-torn"
    OFF = "off"
    SEVER = "sever"
    LINK_DOWN = "link-down"
    SLOW = "slow"
    FULL_FLASH = "full-flash"
    FULL_MEMORY = "full-memory"
    WRONG_BOARD = "wrong-board"
    HOST_KEY = "host-key"
    FOREIGN_DELTA = "foreign-delta"
    CLOCK = "clock"
    SSH_HANG = "ssh-hang"


FAULTS: dict[Fault, str] = {
    Fault.CUT: "power cut and immediate restart; unsynced data is lost (@STEP: when the node reaches that command)",
    Fault.CUT_KEPT: "power cut and immediate restart; all data was synced just before",
    Fault.CUT_TORN: "power cut and immediate restart; unsynced files exist but are empty",
    Fault.OFF: "power cut; the node stays off until repaired",
    Fault.SEVER: "every link of the node goes down (@STEP: when the node reaches that command)",
    Fault.LINK_DOWN: "the link, or every link of the node, goes down",
    Fault.SLOW: "the link, or every link of the node: 300 ms, 5 % loss, 256 kbit/s",
    Fault.FULL_FLASH: "only 8 KiB left in flash",
    Fault.FULL_MEMORY: "/tmp is full and 2 MiB of memory are left",
    Fault.WRONG_BOARD: "the node reports another board name, also after a reboot",
    Fault.HOST_KEY: "new SSH host keys replace the old ones",
    Fault.FOREIGN_DELTA: "the node has an uncommitted UCI change",
    Fault.CLOCK: "the clock is ten years behind",
    Fault.SSH_HANG: "SSH connections are accepted but never answered",
}
STEP_FAULTS = frozenset({Fault.CUT, Fault.SEVER})
# faults that a link can have, too
LINK_FAULTS = frozenset({Fault.LINK_DOWN, Fault.SLOW})
SLOW_DELAY_MS = 300.0
SLOW_LOSS = 0.05
SLOW_RATE_KBPS = 256


@dataclass(frozen=True, slots=True)
class FaultRequest:
    """An empty `step` means now."""

    fault: Fault
    step: str = ""


def describe(request: FaultRequest) -> str:
    """The fault in words, and when it takes effect."""
    text = FAULTS[request.fault].partition(" (@STEP")[0]
    if not request.step:
        return text
    if request.step == "flash":
        return f"{text}; in the middle of the node's next flash"
    return f"{text}; " + (
        f"at command {request.step} from now on"
        if request.step.isdecimal()
        else f"before the first command that contains {request.step!r}"
    )


def parse(text: str) -> FaultRequest:
    """`power-cut@7` -> FaultRequest. Raises InputError that lists the known faults."""
    word, _, step = text.partition("@")
    try:
        what = Fault(word)
    except ValueError:
        raise InputError(
            f"unknown fault {word!r}", hint="known faults: " + ", ".join(fault.value for fault in Fault)
        ) from None
    if step and what not in STEP_FAULTS:
        raise InputError(f"{word} takes effect immediately and takes no @STEP")
    return FaultRequest(what, step)
