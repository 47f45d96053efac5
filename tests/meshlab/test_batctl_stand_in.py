"""batctl's stand-in: tables that meshctl counts, as batctl's transglobal.c prints them."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from meshlab.rootfs import STAND_INS, find_program

BUSYBOX = find_program("busybox", "busybox-static")
EFFECTIVE = "cell\tx\tmesh0\tadhoc\t2437\ta team\t-\tx\t-\t02:00:00:00:00:01\tbat0\tBATMAN_IV\t7\n"
HEARD = (
    "O\tmesh0\t02:00:00:00:00:02\t02:00:00:00:00:02\t251\t120\t1\t1000\n"
    "O\tmesh0\t02:00:00:00:00:03\t02:00:00:00:00:02\t200\t120\t1\t1000\n"
)
ROW = re.compile(
    r" [* ] (?:[0-9a-f]{2}:){5}[0-9a-f]{2} +-?\d+ \[[R.][W.][I.][T.]\] \([ \d]{3}\) (?:[0-9a-f]{2}:){5}[0-9a-f]{2}"
    r" \([ \d]{3}\) \(0x[0-9a-f]{8}\)"
)


def table(directory: Path, command_line: str) -> list[str]:
    for name, text in (("effective", EFFECTIVE), ("heard", HEARD)):
        (directory / name).write_text(text)
    settings = {
        "verb": command_line.split()[0],
        "arguments": command_line,
        "soft": "bat0",
        "uptime": "9",
        "own": "fe:0:0:0:0:1",
    }
    variables = [word for item in settings.items() for word in ("-v", "=".join(item))]
    files = [str(directory / name) for name in ("effective", "heard")]
    command = [str(BUSYBOX), "awk", *variables, "-f", f"{STAND_INS}/lab/batctl.awk", *files]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


def test_the_global_translation_table_has_an_entry_of_each_originator(tmp_path: Path) -> None:
    rows = table(tmp_path, "transglobal -H -n")
    assert len(rows) == 2
    assert all(ROW.fullmatch(row) for row in rows), rows
    assert table(tmp_path, "transglobal -H -u") == rows
    assert table(tmp_path, "transglobal -H -m") == []
    assert table(tmp_path, "tg")[2:] == rows
