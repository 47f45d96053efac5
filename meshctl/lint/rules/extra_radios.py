"""Further radios in extra_uci: channels and powers of access points; options with a typo (MC919 to MC932)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.openwrt_names import one_edit_apart
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.power import (
    ROUNDING_DB,
    conducted_limit_dbm,
    drive_path,
    has_conducted_limit,
    power_sum,
)
from meshctl.lint.rules.rendering import extra_entries, with_extra
from meshctl.model import Fleet, Node, Radio
from meshctl.regdb import CHANNELS, Country, check_span, initiating_channels, primary_span
from meshctl.suggest import suggestion

# the options that inventories set, by package and type of the section; others are compared with these only
_OPTIONS = {
    ("wireless", "wifi-device"): """
        type path phy macaddr band hwmode channel channels htmode country country_ie txpower disabled distance
        beacon_int rts frag diversity rxantenna txantenna antenna_gain noscan ht_coex short_gi_20 short_gi_40 ldpc
        legacy_rates cell_density require_mode basic_rate supported_rates log_level hostapd_options doth chanbw
        acs_exclude_dfs background_radar maxassoc airtime_mode
    """,
    ("wireless", "wifi-iface"): """
        device network mode ssid bssid encryption key disabled hidden isolate ifname macaddr maclist macfilter wds
        mesh_id mesh_fwding mesh_rssi_threshold mcast_rate wmm short_preamble dtim_period max_inactivity maxassoc
        disassoc_low_ack skip_inactivity_poll ieee80211w ieee80211r ieee80211k ieee80211v mobility_domain
        nasid ft_over_ds ft_psk_generate_local wpa_group_rekey wps_pushbutton wps_device_name owe_transition_ssid
        owe_transition_ifname proxy_arp bss_transition rsn_preauth powersave multicast_to_unicast
        multicast_to_unicast_all per_sta_vif vlan_file vlan_naming bridge_isolate server port auth_server auth_port
        auth_secret acct_server acct_port acct_secret eap_type auth identity password ca_cert client_cert priv_key
        addr vif txpower
    """,
    ("network", "interface"): """
        proto device ifname type auto disabled force_link delegate ipaddr netmask gateway broadcast dns dns_search
        dns_metric metric mtu macaddr ip6addr ip6gw ip6assign ip6hint ip6prefix ip6class ip6ifaceid ip4table ip6table
        defaultroute peerdns hostname clientid vendorid reqopts sendopts reqaddress reqprefix norelease username
        password routing_algo gw_mode gw_bandwidth gw_sel_class hop_penalty orig_interval fragmentation
        aggregated_ogms ap_isolation bonding bridge_loop_avoidance distributed_arp_table isolation_mark log_level
        multicast_mode multicast_fanout network_coding multicast_forceflood master elp_interval throughput_override
        private_key listen_port addresses fwmark
    """,
    ("firewall", "zone"): """
        name network device subnet input output forward masq masq6 masq_allow_invalid masq_src masq_dest mtu_fix
        family log log_limit extra extra_src extra_dest helper auto_helper conntrack enabled
    """,
    ("firewall", "forwarding"): "src dest family ipset name enabled",
    ("firewall", "rule"): """
        name src dest src_ip src_mac src_port proto icmp_type dest_ip dest_port device direction ipset mark set_mark
        set_xmark set_dscp dscp start_date stop_date start_time stop_time weekdays monthdays utc_time target family
        limit limit_burst extra enabled helper set_helper log
    """,
    ("dhcp", "dhcp"): """
        interface start limit leasetime dynamicdhcp force ignore netmask dhcp_option dhcp_option_force dhcpv4 dhcpv6 ra
        ra_flags ra_slaac ra_default ra_management ra_lifetime ra_maxinterval ra_mininterval ra_mtu ra_dns ndp master
        dns dns_service domain networkid piofolder prefix_filter instance
    """,
}
_KNOWN = {kind: frozenset(words.split()) for kind, words in _OPTIONS.items()}
# what other programs call an option
_SYNONYMS = {("firewall", "zone", "masquerade"): "masq", ("firewall", "zone", "networks"): "network"}


@fleet_rule(
    "MC919",
    Severity.ERROR,
    "A channel in extra_uci may not be used",
    why="""On a channel of another band, or one that the country does not allow or reserves for radar, the access point
    is not on the air, and a change that adds it is rolled back.""",
    fix="Choose one of the channels that the finding names, or `auto`.",
    failing="nodes: {b01: {extra_uci: {wireless.radio1.channel: '6'}}}",
    passing="nodes: {b01: {extra_uci: {wireless.radio1.channel: '36'}}}",
    is_per_kind=True,
)
def extra_channel(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    country = context.regdb.country(fleet.country)
    for node, packages in with_extra(fleet, context):
        bands = {radio.name: radio.hardware.band for radio in node.radios}
        for key, value, package, section, option in extra_entries(node, packages):
            band = bands.get(section.name or "") if section is not None and package == "wireless" else None
            if band is None or option != "channel" or value in ("", "auto"):
                continue
            legal = initiating_channels(country, band)
            if value not in map(str, legal):
                path = ("nodes", node.name, "extra_uci", key)
                expected = f"one of {', '.join(map(str, legal))}"
                place = f"country {fleet.country}"
                yield Finding(path, f"not for an access point in the {band.value} band ({place})", expected, value)


@fleet_rule(
    "MC920",
    Severity.WARNING,
    "An option of extra_uci is probably misspelled",
    why="""OpenWrt ignores options that it does not know: an access point with a mistyped `device` or `network` is not
    on the air, or leads nowhere, and a gateway with a mistyped `gw_mode` or `masq` serves no client.""",
    fix="Correct the name of the option; suppress this finding if a package of the image reads it.",
    failing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.isolat: '1', wireless.guest.network: visitors,
      network.visitors: interface, network.visitors.proto: none}}}
    """,
    passing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.isolate: '1', wireless.guest.network: visitors,
      network.visitors: interface, network.visitors.proto: none}}}
    """,
    is_per_kind=True,
)
def option_misspelled(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for key, _, package, section, option in extra_entries(node, packages):
            kind = (package, section.type) if section is not None else ("", "")
            known = _KNOWN.get(kind, frozenset())
            if not known or not option or option in known or not (near := _meant(kind, option, known)):
                continue
            path = ("nodes", node.name, "extra_uci", key)
            yield Finding(path, "OpenWrt does not read this option", " or ".join(near), option, suggestion(near))


def _meant(kind: tuple[str, str], option: str, known: frozenset[str]) -> tuple[str, ...]:
    """The options that a name with a typo, its first half, or another program's word probably means."""
    synonym = _SYNONYMS.get((*kind, option))
    cut = [word for word in known if word.startswith(option) and 2 * len(option) >= len(word) and kind != _INTERFACE]
    return (synonym,) if synonym else one_edit_apart(option, known) or (tuple(cut) if len(cut) == 1 else ())


# the one type whose options depend on `proto`, and come from many packages
_INTERFACE = ("network", "interface")


@fleet_rule(
    "MC932",
    Severity.ERROR,
    "The power of an access point exceeds the country's limit",
    why="""A radio that is in no mesh and serves an access point transmits with `tx_power_dbm`, by default the driver's
    maximum. The kernel limits only the drive level, so an amplifier or the antenna's gain can exceed the limit
    unnoticed.""",
    fix="Set the radio's `tx_power_dbm`, lower by the excess.",
    failing="""
    country: DE
    hardware: {rocket: {radios: {radio1: {antenna_gain_dbi: 8}}}}
    defaults: {radios: {radio0: {tx_power_dbm: 15}}}
    nodes: {b01: {radios: {radio1: {tx_power_dbm: 20}}, extra_uci: {wireless.radio1.disabled: '0',
      wireless.radio1.channel: '36', wireless.guest: wifi-iface, wireless.guest.device: radio1, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.network: visitors, network.visitors: interface,
      network.visitors.proto: none}}}
    """,
    passing="""
    country: DE
    hardware: {rocket: {radios: {radio1: {antenna_gain_dbi: 8}}}}
    defaults: {radios: {radio0: {tx_power_dbm: 15}}}
    nodes: {b01: {radios: {radio1: {tx_power_dbm: 15}}, extra_uci: {wireless.radio1.disabled: '0',
      wireless.radio1.channel: '36', wireless.guest: wifi-iface, wireless.guest.device: radio1, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.network: visitors, network.visitors: interface,
      network.visitors.proto: none}}}
    """,
    is_per_kind=True,
)
def access_point_power(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    country = context.regdb.country(fleet.country)
    for node, packages in with_extra(fleet, context):
        wireless = packages.get("wireless")
        if wireless is None or country is None:
            continue
        served = {iface.get("device") for iface in wireless.of_type("wifi-iface") if iface.get("disabled") != "1"}
        for radio in node.radios:
            section = wireless.section(radio.name)
            is_on = section is not None and section.get("disabled") != "1" and radio.name in served
            if section is None or not is_on or radio.mesh is not None:
                continue
            channel = section.get("channel")
            if channel.isdigit() and int(channel) in CHANNELS[radio.hardware.band]:
                yield from _above_limit(fleet, country, node, radio, int(channel))


def _above_limit(fleet: Fleet, country: Country, node: Node, radio: Radio, channel: int) -> Iterator[Finding]:
    band, gain = radio.hardware.band, radio.hardware.antenna_gain_dbi
    if has_conducted_limit(fleet.country, band, channel):
        limit, power, kind = conducted_limit_dbm(gain), radio.conducted_dbm, "conducted"
        total = f"{power_sum(radio)} = {power:g} dBm"
    else:
        legality = check_span(country, primary_span(band, channel))
        if not legality.covered:
            return  # MC919 reports the channel
        limit, power, kind = legality.max_eirp_dbm, radio.eirp_dbm, "EIRP"
        total = f"{power_sum(radio)} + {gain:g} antenna = {power:g} dBm EIRP"
    if power > limit + ROUNDING_DB:
        expected = f"at most {limit:g} dBm {kind} (country {country.alpha2}, channel {channel})"
        yield Finding(
            drive_path(fleet, node, radio), f"{round(power - limit, 2):g} dB above the limit", expected, total
        )
