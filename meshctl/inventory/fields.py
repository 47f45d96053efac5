"""Strict types of single values: how a field interprets the text of a scalar.

The error of a type has the `expected` text in its context; the message never repeats the value, which may be a
misplaced secret.
"""

from __future__ import annotations

import re
from ipaddress import AddressValueError, IPv4Address, ip_address, ip_interface, ip_network
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BeforeValidator, PlainValidator, WithJsonSchema
from pydantic_core import PydanticCustomError

from meshctl.inventory.tree import Plain
from meshctl.model import Release
from meshctl.model.ip import IpAddress, IpInterface, IpNetwork

FORMAT_VERSION = 1
AnyAddress = TypeVar("AnyAddress", bound=IpAddress | IpInterface)

_WHOLE = re.compile(r"[-+]?[0-9]{1,15}")
_REAL = re.compile(r"[-+]?(?:[0-9]{1,15}(?:\.[0-9]{0,15})?|\.[0-9]{1,15})(?:[eE][-+]?[0-9]{1,2})?")
_FLAGS = {"true": True, "false": False, "yes": True, "no": False, "on": True, "off": False}
_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?")
_SWITCH_PORTS = "[0-9]{1,2}t?( [0-9]{1,2}t?)*"
# dev_valid_name() of the kernel: below IFNAMSIZ, and none of these
_PORT = re.compile(r"[^\s/:,]{1,15}")
_DEVICE_PATH = re.compile(r"/[^\x00-\x20\x7f]+")
_MAC = re.compile(r"[0-9A-Fa-f]{2}(?:[:-][0-9A-Fa-f]{2}){5}")
# characters that text on one line must not contain, as rendering requires
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")


def expected_error(expected: str) -> PydanticCustomError:
    """The error that a field type raises; `expected` completes `expected ...` in the message."""
    return PydanticCustomError("meshctl", "expected {expected}", {"expected": expected})


def _whole(value: object) -> object:
    if isinstance(value, Plain) and _WHOLE.fullmatch(value):
        return int(value)
    raise expected_error("a whole number")


def _real(value: object) -> object:
    if isinstance(value, Plain) and _REAL.fullmatch(value):
        return float(value)
    raise expected_error("a number")


def any_flag(value: object) -> object:
    known = _FLAGS.get(value.lower()) if isinstance(value, Plain) else None
    if known is None:
        raise expected_error("true or false")
    return known


def any_text(value: object) -> str:
    if not isinstance(value, str):
        raise expected_error("text")
    if "\0" in value:
        raise expected_error("text without NUL characters")
    return str(value)


def is_name(value: str) -> bool:
    """Names become hostnames, file names and keys: at most 63 letters, digits, `.`, `_`, `-`."""
    return _NAME.fullmatch(value) is not None


def _name(value: str) -> str:
    if is_name(value):
        return value
    raise expected_error(
        "a name of at most 63 letters (a to z), digits, '.', '_' and '-', starting and ending with a letter or digit"
    )


def _line(value: str) -> str:
    # a block scalar (`|`) ends with a line break
    line = value.rstrip("\n")
    if not _CONTROL.search(line):
        return line
    raise expected_error("text on one line, without control characters")


def _mac(value: str) -> str:
    if _MAC.fullmatch(value):
        return value.lower().replace("-", ":")
    raise expected_error("a MAC address such as 02:ca:fe:00:00:01")


def _country(value: str) -> str:
    if re.fullmatch("[A-Z]{2}", value):
        return value
    raise expected_error("a country code of two capital letters such as US")


def _vlan(value: str) -> str:
    # swconfig drivers accept VLANs up to 127 or 4094; 802.1Q allows 4094
    if re.fullmatch("[1-9][0-9]{0,3}", value) and int(value) <= 4094:
        return value
    raise expected_error("a VLAN from 1 to 4094")


def _switch_ports(value: str) -> str:
    if re.fullmatch(_SWITCH_PORTS, value):
        return value
    raise expected_error("port numbers, with 't' after a tagged one, such as 3 0t")


def _port(value: str) -> str:
    if _PORT.fullmatch(value):
        return value
    raise expected_error("the name of one port such as eth0.1, without blanks; commas separate ports")


def _device_path(value: str) -> str:
    if _DEVICE_PATH.fullmatch(value):
        return value
    raise expected_error("the path of a serial port such as /dev/ttyUSB0 or /dev/serial/by-id/...")


def _address(value: object) -> IpAddress:
    try:
        return without_zone(ip_address(any_text(value)))
    except ValueError:
        raise expected_error("an IP address such as 10.42.0.1 or fd42::1") from None


def _ipv4_address(value: object) -> IPv4Address:
    try:
        return IPv4Address(any_text(value))
    except AddressValueError:
        raise expected_error("an IPv4 address such as 10.42.0.1 (the legacy udp_mesh has no IPv6)") from None


def _interface(value: object) -> IpInterface:
    text = any_text(value)
    if "/" in text:
        try:
            return without_zone(ip_interface(text))
        except ValueError:
            pass
    raise expected_error("an IP address with its prefix length such as 10.42.0.100/24 or fd42::100/64")


def _network(value: object) -> IpNetwork:
    text = any_text(value)
    if "/" not in text:
        raise expected_error("a network with its prefix length such as 10.42.0.0/24 or fd42::/64")
    try:
        return ip_network(text)
    except ValueError:
        pass
    try:
        ip_network(text, strict=False)
    except ValueError:
        raise expected_error("a network such as 10.42.0.0/24 or fd42::/64") from None
    raise expected_error("a network address, with all host bits zero")


def without_zone(value: AnyAddress) -> AnyAddress:
    """The address itself. Raises PydanticCustomError for a zone (`fe80::1%eth0`), which has a meaning on one machine
    only."""
    if "%" in str(value):
        raise expected_error("an address without a zone; a link-local address belongs under `ssh.host`")
    return value


def _window(value: object) -> object:
    if value == "adaptive":
        return None
    if isinstance(value, Plain) and _WHOLE.fullmatch(value) and 1 <= int(value) <= 1024:
        return int(value)
    raise expected_error("'adaptive' or a number of fragments from 1 to 1024")


def _version(value: object) -> object:
    if isinstance(value, Plain) and value == str(FORMAT_VERSION):
        return FORMAT_VERSION
    raise expected_error(f"{FORMAT_VERSION}, the version of this format")


def empty_mapping(value: object) -> object:
    """Read an empty section as an empty mapping."""
    return {} if value is None else value


Whole = Annotated[int, BeforeValidator(_whole)]
Real = Annotated[float, BeforeValidator(_real)]
Flag = Annotated[bool, BeforeValidator(any_flag)]
Text = Annotated[str, BeforeValidator(any_text)]
Line = Annotated[str, BeforeValidator(any_text), AfterValidator(_line)]
Name = Annotated[str, BeforeValidator(any_text), AfterValidator(_name)]
Mac = Annotated[
    str,
    BeforeValidator(any_text),
    AfterValidator(_mac),
    WithJsonSchema({"type": "string", "pattern": f"^{_MAC.pattern}$"}),
]
Country = Annotated[
    str,
    BeforeValidator(any_text),
    AfterValidator(_country),
    WithJsonSchema({"type": "string", "pattern": "^[A-Z]{2}$"}),
]
VlanId = Annotated[str, BeforeValidator(any_text), AfterValidator(_vlan)]
SwitchPorts = Annotated[
    str,
    BeforeValidator(any_text),
    AfterValidator(_switch_ports),
    WithJsonSchema({"type": ["string", "integer"], "pattern": f"^{_SWITCH_PORTS}$"}),
]
Port = Annotated[
    str,
    BeforeValidator(any_text),
    AfterValidator(_port),
    WithJsonSchema({"type": "string", "pattern": f"^{_PORT.pattern}$"}),
]
DevicePath = Annotated[
    str,
    BeforeValidator(any_text),
    AfterValidator(_device_path),
    WithJsonSchema({"type": "string", "pattern": "^/.+"}),
]
Version = Annotated[int, BeforeValidator(_version), WithJsonSchema({"const": FORMAT_VERSION})]
Window = Annotated[
    int | None,
    BeforeValidator(_window),
    WithJsonSchema({"anyOf": [{"const": "adaptive"}, {"type": "integer", "minimum": 1, "maximum": 1024}]}),
]
# Releases look like numbers: editors must accept them unquoted, as the loader does.
_RELEASES = [release.value for release in Release]
ReleaseName = Annotated[Release, WithJsonSchema({"enum": [*_RELEASES, *map(float, _RELEASES)]})]
Address = Annotated[
    IpAddress,
    PlainValidator(_address),
    WithJsonSchema({"type": "string", "anyOf": [{"format": "ipv4"}, {"format": "ipv6"}]}),
]
IPv4Only = Annotated[IPv4Address, PlainValidator(_ipv4_address), WithJsonSchema({"type": "string", "format": "ipv4"})]
Interface = Annotated[
    IpInterface, PlainValidator(_interface), WithJsonSchema({"type": "string", "pattern": "^[0-9a-fA-F.:]+/[0-9]+$"})
]
Network = Annotated[
    IpNetwork, PlainValidator(_network), WithJsonSchema({"type": "string", "pattern": "^[0-9a-fA-F.:]+/[0-9]+$"})
]
