"""Addresses of nodes: literal, or a rule for all nodes that share it.

`10.42.0.11` or `fd42::11` uses the prefix length of the mesh's network, `10.42.0.11/24` sets its own.
`{from: 10.42.0.101}` counts up from that address, `{rule: network + 100 + 2 * index}` is a formula. `index` counts
from 1 the nodes that the rule applies to, in the inventory's order: along its range, or through its group or the
defaults.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import AddressValueError, ip_address, ip_interface
from typing import Annotated

from pydantic import PlainValidator, WithJsonSchema

from meshctl.inventory.fields import expected_error, without_zone
from meshctl.model.ip import IpAddress, IpInterface, IpNetwork

_TERM = re.compile(
    r"\s*([+-])?\s*(?:(\d{1,9})\s*\*\s*)?(network|index|\d{1,3}(?:\.\d{1,3}){3}|[\da-fA-F]{0,4}:[\da-fA-F:]+|\d{1,9})(?:\s*\*\s*(\d{1,9}))?\s*"
)


class BadAddress(ValueError):
    """A rule that yields no address for this node; the message says why."""


@dataclass(frozen=True, slots=True)
class AddressRule:
    """`start` (None: the mesh's network) + `offset` + `factor` x index."""

    start: IpAddress | None
    offset: int
    factor: int

    def address(self, network: IpNetwork | None, index: int) -> IpAddress:
        """The address of the node with `index` (from 1). Raises BadAddress."""
        start = self.start
        if start is None:
            if network is None:
                raise BadAddress("the rule uses `network`, but the node is in no mesh")
            start = network.network_address
        try:
            return start + (self.offset + self.factor * index)
        except AddressValueError:
            raise BadAddress(f"the rule exceeds the address range at index {index}") from None


AddressValue = IpInterface | IpAddress | AddressRule


def parse_address(value: object) -> AddressValue:
    """Parse a value of `address`: text, or a mapping with `from` or `rule`."""
    match value:
        case str():
            return _static(str(value))
        case {"from": str() as text, **others} if not others:
            start = _static(str(text))
            if isinstance(start, IpAddress) and not isinstance(start, IpInterface):
                return AddressRule(start, -1, 1)
            raise expected_error("an IP address without a prefix length under `from`")
        case {"rule": str() as text, **others} if not others:
            return parse_rule(str(text))
        case _:
            raise expected_error("an IP address, {from: ADDRESS} or {rule: network + NUMBER + index}")


def _static(text: str) -> IpInterface | IpAddress:
    try:
        found = ip_interface(text) if "/" in text else ip_address(text)
    except ValueError:
        raise expected_error("an IP address such as 10.42.0.11, 10.42.0.11/24 or fd42::11") from None
    return without_zone(found)


def parse_rule(text: str) -> AddressRule:
    """Parse a sum of one start (`network` or an address), numbers and multiples of `index`."""
    refused = expected_error(
        "a sum such as network + 100 + index, of `network` or an address, numbers and multiples of index"
    )
    start: list[IpAddress | None] = []
    offset = factor = at = 0
    while at < len(text):
        match = _TERM.match(text, at)
        if match is None or (match[1] is None) != (at == 0):
            raise refused
        sign = -1 if match[1] == "-" else 1
        times = int(match[2] or 1) * int(match[4] or 1)
        word = match[3]
        if word == "network" or "." in word or ":" in word:
            if match[2] or match[4] or sign < 0:
                raise refused
            address = None if word == "network" else _static(word)
            start.append(address)
        elif word == "index":
            factor += sign * times
        else:
            offset += sign * times * int(word)
        at = match.end()
    if len(start) != 1:
        raise refused
    return AddressRule(start[0], offset, factor)


AddressField = Annotated[
    AddressValue,
    PlainValidator(parse_address),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string", "pattern": r"^([0-9]+(\.[0-9]+){3}|[0-9a-fA-F:]*:[0-9a-fA-F:.]*)(/[0-9]+)?$"},
                {
                    "type": "object",
                    "properties": {
                        "from": {
                            "type": "string",
                            "anyOf": [{"format": "ipv4"}, {"format": "ipv6"}],
                            "description": "The first node's address.",
                        }
                    },
                    "required": ["from"],
                    "additionalProperties": False,
                },
                {
                    "type": "object",
                    "properties": {"rule": {"type": "string", "description": "A sum such as network + 100 + index."}},
                    "required": ["rule"],
                    "additionalProperties": False,
                },
            ]
        }
    ),
]
