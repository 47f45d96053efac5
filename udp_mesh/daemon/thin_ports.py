"""The serial ports of thin links: frames between them and the driver. A port that is missing is tried again."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence

from udp_mesh.core.interfaces import Datagram
from udp_mesh.daemon.driver import Driver
from udp_mesh.daemon.thin_settings import ThinPortConfig
from udp_mesh.links.meshtastic_port import MeshtasticPort
from udp_mesh.links.serial_port import SerialPort, SerialPortConfig

log = logging.getLogger(__name__)

RETRY_S = 2.0
"""Delay before a port that could not be opened, or whose device is gone, is opened again."""


class ThinPorts:
    """The ports of a running daemon."""

    def __init__(self, driver: Driver, configs: Sequence[ThinPortConfig]) -> None:
        self._driver, self._configs = driver, configs
        self._loop = asyncio.get_running_loop()
        self._ports: dict[str, SerialPort | MeshtasticPort] = {}
        self._up: set[str] = set()
        self._retry_timer: asyncio.TimerHandle | None = None
        self.failures: dict[str, str] = {}
        """Why ports are not open, by link."""
        self.refusals: dict[str, str] = {}
        """Why radios do not send what they get, by link."""
        self._register()

    def _register(self) -> None:
        self._thin = self._driver.node.thin
        for config in self._configs:
            self._driver.output.others[config.link] = self._transmit
            self._set_up(config.link, False)

    def apply(self, configs: Sequence[ThinPortConfig]) -> None:
        """Takes over a reloaded configuration, after the core did: only if it changed, ports are opened again."""
        if tuple(configs) == tuple(self._configs) and self._driver.node.thin is self._thin:
            return
        self.close()
        for config in self._configs:
            del self._driver.output.others[config.link]
        self._configs = configs
        self.failures.clear()
        self._register()
        self.start()

    def start(self) -> None:
        """Opens the ports; those that are missing later."""
        self._retry_timer = None
        for config in self._configs:
            if config.link not in self._ports:
                self._open(config)
        if self.failures:
            self._retry_timer = self._loop.call_later(RETRY_S, self.start)

    def close(self) -> None:
        """Closes the ports."""
        if self._retry_timer is not None:
            self._retry_timer.cancel()
        for name in list(self._ports):
            self._close(name)

    def _set_up(self, link: str, up: bool) -> None:
        """The port was opened or is gone: the core needs to know."""
        if self._thin is not None:
            self._thin.set_up(link, up, self._driver.now())
            self._driver.send_soon()

    def _open(self, config: ThinPortConfig) -> None:
        try:
            port = SerialPort(config) if isinstance(config, SerialPortConfig) else MeshtasticPort(config)
        except OSError as error:
            self._failed(config.link, error)
            return
        self._ports[config.link] = port
        self._loop.add_reader(port.fileno(), self._readable, config.link)
        self._note_ready(config.link)

    def _note_ready(self, link: str) -> None:
        """The port takes frames from now on: a radio that has to be connected first, later than it is opened."""
        port = self._ports[link]
        if not port.ready or link in self._up:
            return
        self._up.add(link)
        self.failures.pop(link, None)
        log.info("thin-link-up link=%s device=%s", link, port.config.device)
        self._set_up(link, True)

    def _failed(self, link: str, error: OSError) -> None:
        reason = f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror)
        if self.failures.get(link) != reason:
            log.error("thin-link-failed link=%s reason=%s", link, reason)
        self.failures[link] = reason

    def _close(self, link: str) -> None:
        port = self._ports.pop(link)
        self._up.discard(link)
        self.refusals.pop(link, None)
        self._loop.remove_reader(port.fileno())
        self._loop.remove_writer(port.fileno())
        port.close()

    def _gone(self, link: str, error: OSError) -> None:
        self._close(link)
        self._set_up(link, False)
        self._failed(link, error)
        if self._retry_timer is None:
            self._retry_timer = self._loop.call_later(RETRY_S, self.start)

    def _readable(self, link: str) -> None:
        try:
            frames = self._ports[link].receive()
        except OSError as error:
            self._gone(link, error)
            return
        self._note_ready(link)
        self._note_refusal(link, self._ports[link].refusal)
        if frames:
            self._driver.receive_frames(link, frames)

    def _note_refusal(self, link: str, refusal: str | None) -> None:
        if refusal == self.refusals.get(link):
            return
        if refusal is None:
            del self.refusals[link]
            log.info("thin-link-radio-sends link=%s", link)
        else:
            self.refusals[link] = refusal
            log.warning("thin-link-radio-refuses link=%s reason=%s", link, refusal)

    def _transmit(self, link: str, datagrams: Sequence[Datagram]) -> None:
        port = self._ports.get(link)
        if port is None:
            return
        try:
            for datagram in datagrams:
                port.send(datagram.data)
        except OSError as error:
            self._gone(link, error)
            return
        if port.has_waiting:
            self._loop.add_writer(port.fileno(), self._writable, link)

    def _writable(self, link: str) -> None:
        port = self._ports[link]
        try:
            port.write_more()
        except OSError as error:
            self._gone(link, error)
            return
        if not port.has_waiting:
            self._loop.remove_writer(port.fileno())
