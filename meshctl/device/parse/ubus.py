"""`ubus call`: system board, network.wireless status, network.interface dump (procd, netifd)."""

from __future__ import annotations

from types import MappingProxyType

from meshctl.device.observation import BoardInfo, NetInterface, RadioState, ReleaseInfo
from meshctl.device.parse.jsontext import boolean, integer, mapping, maps, parse_json, string, strings


def parse_board(text: str) -> tuple[BoardInfo, ReleaseInfo | None] | None:
    """`system board`: the board, and the release, if procd reports it (19.07's may not)."""
    data = mapping(parse_json(text))
    if not data:
        return None
    board = BoardInfo(
        board_name=string(data.get("board_name")),
        model=string(data.get("model")),
        hostname=string(data.get("hostname")),
        kernel=string(data.get("kernel")),
    )
    release = mapping(data.get("release"))
    if not string(release.get("version")):
        return board, None
    return board, ReleaseInfo(
        distribution=string(release.get("distribution")),
        version=string(release.get("version")),
        revision=string(release.get("revision")),
        target=string(release.get("target")),
        description=string(release.get("description")),
    )


def parse_wireless(text: str) -> tuple[RadioState, ...] | None:
    """`network.wireless status`: an object of radios by name."""
    data = parse_json(text)
    if not isinstance(data, dict):
        return None
    return tuple(
        RadioState(
            name=name,
            up=boolean(radio.get("up")),
            pending=boolean(radio.get("pending")),
            disabled=boolean(radio.get("disabled")),
            setup_failed=boolean(radio.get("retry_setup_failed")),
            config=MappingProxyType({key: string(value) for key, value in mapping(radio.get("config")).items()}),
            interfaces=tuple(
                (string(item.get("section")), string(item.get("ifname"))) for item in maps(radio.get("interfaces"))
            ),
        )
        for name, radio in ((name, mapping(value)) for name, value in data.items())
        if radio
    )


def parse_interfaces(text: str) -> tuple[NetInterface, ...] | None:
    """`network.interface dump`: `{"interface": [...]}`."""
    data = parse_json(text)
    if not isinstance(data, dict) or not isinstance(data.get("interface"), list):
        return None
    return tuple(
        NetInterface(
            name=string(item.get("interface")),
            up=boolean(item.get("up")),
            pending=boolean(item.get("pending")),
            device=string(item.get("l3_device")) or string(item.get("device")),
            addresses=tuple(
                f"{string(address.get('address'))}/{integer(address.get('mask'))}"
                for family in ("ipv4-address", "ipv6-address")
                for address in maps(item.get(family))
                if string(address.get("address")) and integer(address.get("mask")) is not None
            ),
            errors=tuple(string(error.get("code")) for error in maps(item.get("errors"))),
        )
        for item in maps(data["interface"])
    )


def parse_board_json(text: str) -> BoardInfo | None:
    """/etc/board.json: the LAN's ports, the MAC address printed on the label where the board knows it, and switches.

    `ports` where there are several, else `device` (21.02 and later) or `ifname` (19.07). A switch's VLANs are the
    places of its `roles`, counted from 1 (base-files, `config_generate`).
    """
    data = mapping(parse_json(text))
    if not data:
        return None
    lan = mapping(mapping(data.get("network")).get("lan"))
    ports = next((found for key in ("ports", "device", "ifname") if (found := strings(lan.get(key)))), ())
    vlans = tuple(
        (name, str(vlan), string(role.get("ports")))
        for name, switch in mapping(data.get("switch")).items()
        for vlan, role in enumerate(maps(mapping(switch).get("roles")), 1)
        if string(role.get("ports"))
    )
    label = string(mapping(data.get("system")).get("label_macaddr")).lower()
    return BoardInfo("", lan_ports=ports, label_mac=label, switch_vlans=vlans)
