"""Every alarm's code and what it means: stable words for filters, scripts and docs/status.md."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

CODES: Mapping[str, str] = MappingProxyType(
    {
        # radios and robots' computers
        "unreachable": "it must answer and does not",
        "mute": "it may be off, yet others hear it, and it does not answer",
        "host-key": "it shows another SSH host key than the pinned one",
        "untrusted": "no host key is pinned for it",
        "login": "it lets none of our keys in",
        "failed": "it answers, and what was asked of it failed",
        "drift": "its configuration is not what the inventory says",
        "rebooted": "it started anew since the last look",
        "clock": "its clock is off",
        "memory": "hardly any memory is left",
        "load": "more wants to run there than it can",
        # radios
        "board": "another device than the inventory's has its address",
        "refused": "it could not be provisioned as it is",
        "firmware": "another firmware than the inventory's",
        "packages": "packages are missing",
        "radio": "a radio that belongs to a mesh is down",
        "join": "a radio has joined no cell",
        "channel": "a radio is on another channel than its mesh",
        "alone": "it hears nobody, and should",
        "no-path": "no path through the mesh leads from it to the base",
        "weak": "its path to the base carries little",
        "dropped": "a beacon carried by the inventory relays for others, or did when it was last seen",
        "cut-vertex": "others reach the base through it alone",
        "bridge": "a LAN port, or the mesh, is in no bridge",
        "flash": "hardly any flash is left",
        "change": "a change waits for its confirmation, or is being undone",
        "locked": "another operator has locked it",
        "foreign": "somebody changed it by hand and did not commit that",
        # robots
        "not-installed": "udp_mesh is not on it",
        "daemon": "its daemon is down, or does not answer",
        "unproven": "a switch to another release was cut short",
        "restarts": "its daemon died and was started again since the last look",
        "ros-bridge": "its ROS bridge is down",
        "version": "its daemon has another version than most",
        "key": "another robot cannot open what it seals",
        "unkeyed": "it neither encrypts nor authenticates",
        "peers": "it does not hear a robot whose daemon runs",
        "urgent-queue": "urgent messages wait",
        "topic-undeclared": "its daemon lacks a topic of the inventory, or has it with another priority",
        "topic-silent": "it sends nothing on a topic for longer than the topic's rate and deadline allow",
        "topic-not-arriving": "a robot it hears sends on a topic, and nothing arrives",
        "disk": "hardly any disk is left",
        # the fleet
        "stranger": "a device of no inventory is in the mesh",
        "not-compared": "somebody could not be held against the inventory, mostly for want of a secret",
        "robots-unasked": "no robot was asked",
    }
)
