"""What can be done to a virtual fleet: the words of `meshctl lab break`, parsed.

`WHERE` is a node or a link (`b01-b02`); `WHAT` is one of `BREAKS`, some with `@STEP`: the n-th external command the
node runs from now on, or the first whose words hold a text (`cut@uci commit`), or `flash` for the middle of a flash.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from meshctl.errors import InputError


class Break(Enum):
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


BREAKS: dict[Break, str] = {
    Break.CUT: "power cut and back at once; what was not synced is lost (@STEP: when it comes to that command)",
    Break.CUT_KEPT: "the same, but the kernel had just written everything",
    Break.CUT_TORN: "the same, but files not synced are there and empty",
    Break.OFF: "power cut, and it stays off until mended",
    Break.SEVER: "every link of the node goes down (@STEP: when it comes to that command)",
    Break.LINK_DOWN: "the link, or every link of the node, goes down",
    Break.SLOW: "the link, or every link of the node: 300 ms, 5 % loss, 256 kbit/s",
    Break.FULL_FLASH: "no space left in flash but 8 KiB",
    Break.FULL_MEMORY: "/tmp full and 2 MiB of memory left",
    Break.WRONG_BOARD: "the node says it is another board (from its next boot on)",
    Break.HOST_KEY: "the SSH host keys are other ones, and stay so",
    Break.FOREIGN_DELTA: "somebody left an uncommitted UCI change",
    Break.CLOCK: "the clock is ten years back",
    Break.SSH_HANG: "SSH connections are accepted and then nothing happens",
}
STEPPED = frozenset({Break.CUT, Break.SEVER})
# what a link takes, too
OF_LINKS = frozenset({Break.LINK_DOWN, Break.SLOW})
SLOW_DELAY_MS = 300.0
SLOW_LOSS = 0.05
SLOW_RATE_KBPS = 256


@dataclass(frozen=True, slots=True)
class Order:
    """`step` is empty for at once."""

    what: Break
    step: str = ""


def told(order: Order) -> str:
    """What happens now, or what will and when, for whoever ordered it."""
    text = BREAKS[order.what].partition(" (@STEP")[0]
    if not order.step:
        return text
    if order.step == "flash":
        return f"{text}; in the middle of its next flash"
    return f"{text}; " + (
        f"at command {order.step} that it runs from now on"
        if order.step.isdecimal()
        else f"before the first command whose words hold {order.step!r}"
    )


def parse(text: str) -> Order:
    """`power-cut@7` -> Order. Raises InputError naming the words there are."""
    word, _, step = text.partition("@")
    try:
        what = Break(word)
    except ValueError:
        raise InputError(
            f"no break is called {word!r}", hint="there are: " + ", ".join(one.value for one in Break)
        ) from None
    if step and what not in STEPPED:
        raise InputError(f"{word} happens at once and takes no @STEP")
    return Order(what, step)
