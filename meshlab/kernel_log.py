"""A kernel's console -> which of its tasks are stuck, and where.

Linux reports a task that has waited uninterruptibly for longer than `kernel.hung_task_timeout_secs` with its stack
(kernel/hung_task.c). On one that never continues, every later request to a machine ends with a timeout alone, which
says nothing of the cause.
"""

from __future__ import annotations

import re

# the console of a fleet's machine, in the fleet's directory
CONSOLE = "console"

_BLOCKED = re.compile(r"INFO: task (?P<name>\S+):\d+ blocked for more than \d+ seconds")
_FRAME = re.compile(r"^\[[ \d.]+\]  (?P<function>[A-Za-z_]\w*)[.\w]*\+0x")
_STACK_END = "</TASK>"
# how a task waits, which is the same for all of them
_WAITING = re.compile(r"_*(schedule|mutex_lock|io_schedule|wait_for_com|down_(read|write)|rwsem_down)")
_FRAMES = 4
_TASKS = 6


def blocked_tasks(console: str) -> tuple[str, ...]:
    """The tasks that the kernel reported as blocked: `NAME in FUNCTION < CALLER < ...`, each once, oldest first."""
    found: dict[str, None] = {}
    name, functions = "", list[str]()
    for line in console.splitlines():
        if blocked := _BLOCKED.search(line):
            name, functions = blocked["name"], []
        elif name and _STACK_END in line:
            found[f"{name} in {' < '.join(functions[:_FRAMES]) or 'an unknown function'}"] = None
            name = ""
        elif name and (frame := _FRAME.match(line)) and not _WAITING.match(frame["function"]):
            functions.append(frame["function"])
    return tuple(found)[:_TASKS]
