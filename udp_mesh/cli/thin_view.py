"""Formats the thin links of a status for people. Pure."""

from __future__ import annotations

from typing import Any

from udp_mesh.cli.output import duration, rate, table

Json = dict[str, Any]


def thin_view(thin: Json) -> list[str]:
    """Links with their budgets, nodes that are heard on them, and what is wrong."""
    rows = [
        [
            link["name"],
            "up" if link["up"] else "DOWN",
            rate(link["bits_per_s"]),
            f"{link['frame_bytes']} B",
            f"{link['budget_s']:g} s in {duration(link['window_s'])}",
            f"{link['available_s']:.2f} s",
            str(link["queued_messages"]),
            str(link["counters"]["frames_sent"]),
            str(link["counters"]["frames_received"]),
        ]
        for link in thin["links"]
    ]
    lines = [
        "",
        table(["thin link", "state", "rate", "frame", "airtime", "free now", "waiting", "sent", "received"], rows),
    ]
    peers = [
        [
            peer["name"],
            str(peer["number"]),
            ", ".join(peer["links"]),
            duration(peer["heard_ago_s"]),
            "SILENT" if not peer["present"] else "ONLY HERE" if peer["only_thin"] else "also elsewhere",
        ]
        for peer in thin["peers"]
    ]
    if peers:
        lines += ["", table(["heard", "number", "thin link", "ago", "reached"], peers)]
    return lines + [f"THIN LINK {alarm}" for alarm in alarms(thin)]


def alarms(thin: Json) -> list[str]:
    """Problems that need an operator: a name, the problem, the remedy."""
    found = [f"{name} FAILED: {reason}" for name, reason in thin["failures"].items()]
    # A daemon of an earlier version has none.
    found += [f"{name}: the RADIO REFUSES frames: {reason}" for name, reason in thin.get("refusals", {}).items()]
    for link in thin["links"]:
        if link["rejecting_s"] is not None:
            found.append(
                f"{link['name']} REJECTS EVERYTHING for {duration(link['rejecting_s'])}: "
                f"{link['failed_authentications']} frames were forged or damaged; look for a foreign transmitter"
            )
        if link["waits_for_budget_s"] is not None:
            wait = duration(link["waits_for_budget_s"])
            found.append(f"{link['name']} has USED ITS AIRTIME: the next frame leaves in {wait}; send less on it")
    if thin["own_number_used_by"]:
        found.append(f"number {thin['number']} is ALSO USED BY {thin['own_number_used_by']}: give each node its own")
    found += [
        f"number {peer['number']} was used by {peer['conflicting_name']} and {peer['name']}: give each node its own"
        for peer in thin["peers"]
        if peer["conflicting_name"]
    ]
    return found
