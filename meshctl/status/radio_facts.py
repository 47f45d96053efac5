"""Measurements of each radio: observation -> noise, busy time, queue, SNR and MCS of the nodes it hears. Pure."""

from __future__ import annotations

from collections.abc import Mapping

from meshctl.device.observation import ChannelSurvey, Observation, Sensors, Station
from meshctl.model import Node
from meshctl.status.values import Neighbor, RadioStatus
from meshctl.topology import HeardNeighbor

# Counters of a shorter time say more about this very query than about the channel.
MIN_BUSY_MS = 200
_NO_SENSORS = Sensors({}, {})
# batman-adv hears a neighbor over a cable, too
_NO_STATION = Station("", "")


def radios_of(node: Node, observation: Observation, previous: Observation | None = None) -> tuple[RadioStatus, ...]:
    """The interfaces of a node's meshes. `previous` is an earlier observation: the busy time is that since then."""
    surveys = {survey.ifname: survey for survey in observation.surveys or ()}
    before = {survey.ifname: survey for survey in (previous.surveys if previous is not None else None) or ()}
    sensors = observation.sensors or _NO_SENSORS
    found = []
    for link in observation.links or ():
        mesh = node.mesh_interfaces.get(link.ifname)
        if mesh is None:
            continue
        survey = surveys.get(link.ifname)
        busy, over_s = _busy(survey, before.get(link.ifname))
        found.append(
            RadioStatus(
                ifname=link.ifname,
                mesh=mesh,
                channel=link.channel,
                noise_dbm=None if survey is None else survey.noise_dbm,
                busy_ratio=busy,
                busy_over_s=over_s,
                queue_packets=sensors.queued_packets.get(link.phy),
                temperature_c=sensors.temperatures_c.get(link.phy),
            )
        )
    return tuple(found)


def _busy(survey: ChannelSurvey | None, before: ChannelSurvey | None) -> tuple[float | None, float | None]:
    """The share of time in which the channel was busy, and over how many seconds: since `before`, or since the radio
    came up."""
    if survey is None or survey.active_ms is None or survey.busy_ms is None:
        return None, None
    active, busy = survey.active_ms, survey.busy_ms
    if (
        before is not None
        and before.frequency_mhz == survey.frequency_mhz
        and before.active_ms is not None
        and before.busy_ms is not None
        # a radio that was restarted since counts from zero
        and active - before.active_ms >= MIN_BUSY_MS
        and busy >= before.busy_ms
    ):
        active, busy = active - before.active_ms, busy - before.busy_ms
    if active < MIN_BUSY_MS:
        return None, None
    return min(1.0, busy / active), active / 1000


def temperature_of(observation: Observation) -> float | None:
    """The highest temperature that the board reports."""
    return max((observation.sensors or _NO_SENSORS).temperatures_c.values(), default=None)


def snr_of(observation: Observation, heard: Mapping[str, HeardNeighbor]) -> dict[str, int]:
    """The SNR of each node that a node hears, as far as the radio reports signal and noise."""
    noise = {survey.ifname: survey.noise_dbm for survey in observation.surveys or ()}
    at = {station.mac.lower(): noise.get(station.ifname) for station in observation.stations or ()}
    return {
        name: neighbor.signal_dbm - noise_dbm
        for name, neighbor in heard.items()
        if neighbor.signal_dbm is not None and (noise_dbm := at.get(neighbor.mac.lower())) is not None
    }


def neighbors_of(
    node: Node | None, observation: Observation, heard: Mapping[str, HeardNeighbor], snr_there: Mapping[str, int | None]
) -> tuple[Neighbor, ...]:
    """A node's reports of the nodes it hears, best first; `snr_there` is the SNR at which they report to hear it."""
    stations: dict[str, Station] = {}
    for station in observation.stations or ():
        stations.setdefault(station.mac.lower(), station)
    noise = {survey.ifname: survey.noise_dbm for survey in observation.surveys or ()}
    meshes = {} if node is None else node.mesh_interfaces
    found = [
        _neighbor(name, neighbor, stations.get(neighbor.mac.lower(), _NO_STATION), noise, meshes, snr_there.get(name))
        for name, neighbor in heard.items()
    ]
    return tuple(
        sorted(found, key=lambda neighbor: (-(neighbor.quality or 0.0), -(neighbor.signal_dbm or -200), neighbor.name))
    )


def _neighbor(
    name: str,
    heard: HeardNeighbor,
    station: Station,
    noise: Mapping[str, int | None],
    meshes: Mapping[str, str],
    snr_there_db: int | None,
) -> Neighbor:
    noise_dbm = noise.get(station.ifname)
    signal_dbm = heard.signal_dbm
    return Neighbor(
        name,
        heard.last_seen_ms,
        heard.quality,
        signal_dbm,
        mesh=meshes.get(station.ifname, ""),
        noise_dbm=noise_dbm,
        snr_db=None if noise_dbm is None or signal_dbm is None else signal_dbm - noise_dbm,
        snr_there_db=snr_there_db,
        chain_signals_dbm=station.chain_signals_dbm,
        tx_mcs=station.tx_mcs,
        rx_mcs=station.rx_mcs,
        tx_bitrate_kbit_s=_kbit_s(station.tx_mbit_s),
        rx_bitrate_kbit_s=_kbit_s(station.rx_mbit_s),
        expected_kbit_s=_kbit_s(station.expected_mbit_s),
        tx_packets=station.tx_packets,
        tx_retries=station.tx_retries,
        tx_failed=station.tx_failed,
    )


def _kbit_s(mbit_s: float | None) -> int | None:
    return None if mbit_s is None else round(1000 * mbit_s)
