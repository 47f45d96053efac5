"""Parts that the inventories of tests have in common. They have no braces, so that `str.format` leaves them alone."""

from __future__ import annotations


def compex_hardware(release: str, *, confirm_window_s: int | None = None) -> str:
    """The entry `box` of `hardware`: a Compex WPJ344 with one 2.4 GHz radio."""
    window = "" if confirm_window_s is None else f"    confirm_window_s: {confirm_window_s}\n"
    return f"""\
  box:
    board: compex,wpj344-16m
    profile: compex_wpj344-16m
    target: ath79/generic
    release: "{release}"
    lan_ports: [eth0]
{window}    radios:
      radio0:
        path: platform/ahb/18100000.wmac
        band: 2g
        rated_power_dbm: 30
        max_drive_dbm: 27
"""
