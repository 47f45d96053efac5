"""Alarm codes and their meanings. Codes are stable: filters, scripts and docs/status.md use them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

FORMER_DEVICE = "former-device"
CODES: Mapping[str, str] = MappingProxyType(
    {
        # radios and robots' computers
        "unreachable": "required, but does not answer",
        "mute": "optional and does not answer, but other nodes hear it",
        "host-key": "its SSH host key differs from the pinned one",
        "untrusted": "no SSH host key is pinned for it",
        "login": "it rejects all of our keys",
        "failed": "it answers, but a query failed",
        "drift": "its configuration differs from the inventory",
        "rebooted": "it rebooted since the last snapshot",
        "clock": "its clock is wrong",
        "memory": "low on memory",
        "load": "overloaded",
        # radios
        "board": "the device at its address is of another model than in the inventory",
        "refused": "it cannot be provisioned in its current state",
        "firmware": "its firmware differs from the inventory",
        "packages": "packages are missing",
        "radio": "a mesh radio is down",
        "join": "a radio has not joined a cell",
        "left-over": "a radio interface that its configuration has turned off is on the air",
        "channel": "a radio is on another channel than its mesh",
        "alone": "deployed, but hears no other node",
        "no-path": "no path through the mesh to the base",
        "weak": "the quality of its path to the base is low",
        "snr": "the signal to the next hop is hardly above the noise",
        "busy": "its channel is busy most of the time",
        "radio-queue": "many packets wait in its radio",
        "dropped": "a beacon marked as carried relays for others, or did when last seen, or is away from its robot",
        "cut-vertex": "others reach the base only through it",
        "bridge": "a LAN port or the mesh is not in a bridge",
        "lan-filter": "its LAN filter is not loaded",
        "flash": "low on flash storage",
        "change": "a change awaits confirmation or is being rolled back, or services still reload after a rollback",
        "locked": "locked by another operator",
        "foreign": "uncommitted changes were made by hand",
        # robots
        "not-installed": "udp_mesh is not installed",
        "daemon": "its daemon is down or does not answer",
        "unproven": "a switch to another release was interrupted",
        "restarts": "its daemon crashed and was restarted since the last snapshot",
        "ros-bridge": "its ROS bridge is down",
        "hosts": "the service that keeps the peers' names in /etc/hosts is down",
        "collector": "its collector is down, or its radios do not answer it",
        "version": "its daemon version differs from most others",
        "key": "another robot cannot decrypt its messages",
        "unkeyed": "it neither encrypts nor authenticates",
        "peers": "it does not hear a robot whose daemon runs",
        "thin-link": "a thin link does not work, or two robots have one number there",
        "thin-airtime": "a thin link has used the airtime that its band allows",
        "thin-only": "it reaches a robot by thin links only",
        "urgent-queue": "urgent messages are queued",
        "topic-undeclared": "its daemon lacks a topic of the inventory, or has it with another priority",
        "topic-silent": "it sends nothing on a topic for longer than the topic's rate and deadline allow",
        "topic-not-arriving": "a robot it hears sends on a topic, but nothing arrives",
        "disk": "low on disk space",
        "computer-silent": "another computer on its switch does not answer",
        # the fleet
        "stranger": "a device that is not in the inventory is in the mesh",
        FORMER_DEVICE: "the former device of a replaced node is in the mesh again",
        "site": "a site's worker or gateway does not answer: how old the last known state of its nodes is",
        "not-compared": "a device could not be compared with the inventory, usually because a secret is missing",
        "robots-unasked": "no robot was queried",
    }
)
