"""What can be done to a virtual fleet: the words of `meshctl lab break`, parsed.

`WHERE` is a node or a link (`b01-b02`); `WHAT` is one of `BREAKS`, some with `@STEP`: the n-th external command the
node runs from now on, or the first whose words hold a text (`cut@uci commit`), or `flash` for the middle of a flash.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from meshctl.errors import InputError


class Fault(Enum):
    """The value is the word on the command line."""

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
    Fault.CUT: "power cut and back at once; what was not synced is lost (@STEP: when it comes to that command)",
    Fault.CUT_KEPT: "the same, but the kernel had just written everything",
    Fault.CUT_TORN: "the same, but files not synced are there and empty",
    Fault.OFF: "power cut, and it stays off until mended",
    Fault.SEVER: "every link of the node goes down (@STEP: when it comes to that command)",
    Fault.LINK_DOWN: "the link, or every link of the node, goes down",
    Fault.SLOW: "the link, or every link of the node: 300 ms, 5 % loss, 256 kbit/s",
    Fault.FULL_FLASH: "no space left in flash but 8 KiB",
    Fault.FULL_MEMORY: "/tmp full and 2 MiB of memory left",
    Fault.WRONG_BOARD: "the node says it is another board (from its next boot on)",
    Fault.HOST_KEY: "the SSH host keys are other ones, and stay so",
    Fault.FOREIGN_DELTA: "somebody left an uncommitted UCI change",
    Fault.CLOCK: "the clock is ten years back",
    Fault.SSH_HANG: "SSH connections are accepted and then nothing happens",
}
STEP_FAULTS = frozenset({Fault.CUT, Fault.SEVER})
# what a link takes, too
LINK_FAULTS = frozenset({Fault.LINK_DOWN, Fault.SLOW})
SLOW_DELAY_MS = 300.0
SLOW_LOSS = 0.05
SLOW_RATE_KBPS = 256


@dataclass(frozen=True, slots=True)
class FaultRequest:
    """`step` is empty for at once."""

    fault: Fault
    step: str = ""


def describe(request: FaultRequest) -> str:
    """What happens now, or what will and when, for whoever ordered it."""
    text = FAULTS[request.fault].partition(" (@STEP")[0]
    if not request.step:
        return text
    if request.step == "flash":
        return f"{text}; in the middle of its next flash"
    return f"{text}; " + (
        f"at command {request.step} that it runs from now on"
        if request.step.isdecimal()
        else f"before the first command whose words hold {request.step!r}"
    )


def parse(text: str) -> FaultRequest:
    """`power-cut@7` -> Order. Raises InputError naming the words there are."""
    word, _, step = text.partition("@")
    try:
        what = Fault(word)
    except ValueError:
        raise InputError(
            f"no break is called {word!r}", hint="there are: " + ", ".join(one.value for one in Fault)
        ) from None
    if step and what not in STEP_FAULTS:
        raise InputError(f"{word} happens at once and takes no @STEP")
    return FaultRequest(what, step)
