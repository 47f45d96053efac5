"""Further radios in extra_uci: the channels of access points, and options with a typo (MC919 to MC920)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.openwrt_names import one_edit_apart
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.rendering import extra_entries, with_extra
from meshctl.model import Fleet
from meshctl.regdb import initiating_channels
from meshctl.suggest import suggestion

# the options of wireless that inventories set; others are compared with these only
_OPTIONS = {
    "wifi-device": """
        type path phy macaddr band hwmode channel channels htmode country country_ie txpower disabled distance
        beacon_int rts frag diversity rxantenna txantenna antenna_gain noscan ht_coex short_gi_20 short_gi_40 ldpc
        legacy_rates cell_density require_mode basic_rate supported_rates log_level hostapd_options doth chanbw
        acs_exclude_dfs background_radar maxassoc airtime_mode
    """,
    "wifi-iface": """
        device network mode ssid bssid encryption key disabled hidden isolate ifname macaddr maclist macfilter wds
        mesh_id mesh_fwding mesh_rssi_threshold mcast_rate wmm short_preamble dtim_period max_inactivity maxassoc
        disassoc_low_ack skip_inactivity_poll ieee80211w ieee80211r ieee80211k ieee80211v mobility_domain
        nasid ft_over_ds ft_psk_generate_local wpa_group_rekey wps_pushbutton wps_device_name owe_transition_ssid
        owe_transition_ifname proxy_arp bss_transition rsn_preauth powersave multicast_to_unicast
        multicast_to_unicast_all per_sta_vif vlan_file vlan_naming bridge_isolate server port auth_server auth_port
        auth_secret acct_server acct_port acct_secret eap_type auth identity password ca_cert client_cert priv_key
        addr vif txpower
    """,
}
_KNOWN = {kind: frozenset(words.split()) for kind, words in _OPTIONS.items()}


@fleet_rule(
    "MC919",
    Severity.ERROR,
    "A channel in extra_uci may not be used",
    why="""On a channel of another band, or one that the country does not allow or reserves for radar, the access point
    is not on the air, and a change that adds it is rolled back.""",
    fix="Choose one of the channels that the finding names, or `auto`.",
    failing="nodes: {b01: {extra_uci: {wireless.radio1.channel: '6'}}}",
    passing="nodes: {b01: {extra_uci: {wireless.radio1.channel: '36'}}}",
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
    on the air, or leads nowhere.""",
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
)
def option_misspelled(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for key, _, package, section, option in extra_entries(node, packages):
            known = _KNOWN.get(section.type) if section is not None and package == "wireless" else None
            if not known or not option or option in known or not (near := one_edit_apart(option, known)):
                continue
            path = ("nodes", node.name, "extra_uci", key)
            yield Finding(path, "OpenWrt does not read this option", " or ".join(near), option, suggestion(near))
