"""A server that lets nothing come back is the fault of a stale station entry only if the node may have restarted."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.apply.stale_stations import LoginPlace, StationEntry, flush_script
from tests.meshctl.apply.test_stale_stations import ANSWERED, KNOWN, LOST, MAC, SENT, Second, deletions

BEFORE, SINCE_BOOT = "76:9f:08:ba:c9:d5", "12:d2:2c:e6:18:48"
# batctl 2022.3 of 25.12.5's neighbor, after the change of a firewall that dropped b03's SSH
TABLE = """[B.A.T.M.A.N. adv 2022.3, MainIF/MAC: mesh0/02:00:00:00:02:00 (bat0/76:a5:42:48:65:18 BATMAN_IV)]
   Client             VID Flags Last ttvn     Via        ttvn  (CRC       )
 * 56:bb:ac:56:85:aa    0 [....] (  2) 02:00:00:00:01:00 (  6) (0x77b2591e)
 * 76:9f:08:ba:c9:d5   -1 [....] (  1) 02:00:00:00:03:00 (  1) (0xc033361d)
"""


@pytest.mark.parametrize(
    ("announced", "echo", "printed"),
    [
        (BEFORE, ANSWERED, f"answers {MAC}\n"),
        (BEFORE.upper(), ANSWERED, f"answers {MAC}\n"),
        # it has rebooted
        (SINCE_BOOT, ANSWERED, f"gone {MAC}\n"),
        # unknown, or its change restarts a radio
        ("", ANSWERED, f"gone {MAC}\n"),
        # no echo request is answered: nothing but a stale entry explains that
        (BEFORE, LOST, f"gone {MAC}\n"),
    ],
)
def test_the_entry_of_a_node_that_has_not_restarted_is_kept_although_its_server_is_silent(
    tmp_path: Path, announced: str, echo: str, printed: str
) -> None:
    """Seen on 25.12.5: b03 dropped what its SSH server sent, b02 removed b03's entry after the rollback, and from then
    on b03 dropped b02's unicast frames, too."""
    (tmp_path / "memory").mkdir()
    for name, text in (("login", ""), ("connections", SENT), ("arp", KNOWN), ("table", TABLE)):
        (tmp_path / name).write_text(text)
    login = LoginPlace("10.42.0.11", 22, announced)
    text = flush_script([StationEntry("b02", "mesh0", MAC)], older_than_s=11.2, login=login)
    assert deletions(tmp_path, [Second(100, 50, echo)] * 9, text)[0] == printed
