"""The daemon from start to end.

1. The links, the local socket and the metrics' port are opened, then privileges are dropped.
2. systemd hears that the daemon is ready; from then on it hears a sign of life twice per watchdog period.
3. SIGHUP reads the configuration again; SIGTERM and SIGINT end the daemon: good-byes are sent, files are closed.
"""

from __future__ import annotations

import asyncio
import faulthandler
import gc
import logging
import os
import random
import signal
import time
from typing import Any

from udp_mesh.daemon.api import LocalServer, RequestError
from udp_mesh.daemon.commands import COMMANDS, render_metrics
from udp_mesh.daemon.configuration import Configuration, load
from udp_mesh.daemon.file_access import FILE_TIMEOUT_S, off_loop
from udp_mesh.daemon.metrics_server import MetricsServer
from udp_mesh.daemon.privileges import drop_privileges
from udp_mesh.daemon.sd_notify import Notifier
from udp_mesh.daemon.service import Service
from udp_mesh.daemon.toml_source import ConfigurationError
from udp_mesh.wire.limits import BOOT_ID_BYTES

log = logging.getLogger(__name__)

GC_THRESHOLDS = (20_000, 50, 50)
"""The transport makes few cycles; the default of 700 collects hundreds of times a second under load."""


async def run(configuration: Configuration) -> None:
    """Runs the daemon until SIGTERM or SIGINT. Raises OSError where it cannot start."""
    if configuration.settings.unkeyed:
        log.warning("UNKEYED everything is sent without protection: anyone on the network can read, forge and inject")
    service = Service(configuration, boot_id=os.urandom(BOOT_ID_BYTES), rng=random.SystemRandom(), wall_clock=time.time)
    service.commands.update(COMMANDS)
    daemon = configuration.daemon
    server = LocalServer(
        service,
        daemon.socket,
        mode=daemon.socket_mode,
        group=daemon.socket_group,
        max_payload_bytes=lambda: service.settings.limits.message_bytes,
    )
    metrics = None
    if daemon.metrics_address is not None:
        metrics = MetricsServer(daemon.metrics_address, lambda: render_metrics(service))
    notifier = Notifier()
    try:
        await server.start()
        if metrics is not None:
            await metrics.start()
        service.start()
        if daemon.user is not None:
            drop_privileges(daemon.user, (daemon.state_directory,))
        await _serve(service, notifier)
    finally:
        notifier.stopping()
        await server.close()
        if metrics is not None:
            await metrics.close()
        await service.close()
        notifier.close()
        log.info("stopped")


async def _serve(service: Service, notifier: Notifier) -> None:
    loop = asyncio.get_running_loop()
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    reloads: set[asyncio.Task[None]] = set()

    def reload() -> None:
        task = loop.create_task(_reload(service, notifier))
        reloads.add(task)
        task.add_done_callback(reloads.discard)

    loop.add_signal_handler(signal.SIGHUP, reload)
    loop.set_exception_handler(_log_unhandled_error)
    # A daemon that hangs on a robot far away: SIGUSR1 writes where to its log.
    faulthandler.register(signal.SIGUSR1)
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GC_THRESHOLDS)
    notifier.ready(_status(service))
    log.info("ready name=%s port=%d boot=%s", service.settings.name, service.settings.port, service.boot_id.hex())
    if not service.driver.hub.links:
        log.warning("no-link no configured interface is up with an address; links are taken as they come")
    period_s = notifier.watchdog_s
    while not stop.is_set():
        try:
            async with asyncio.timeout(period_s):
                await stop.wait()
        except TimeoutError:
            notifier.alive(_status(service))


def _log_unhandled_error(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """What nobody expected is written down, and the daemon goes on: a robot's link matters more than a clean end."""
    log.error("bug message=%s", context.get("message"), exc_info=context.get("exception"))


async def _reload(service: Service, notifier: Notifier) -> None:
    """On SIGHUP: a file with problems changes nothing, and each problem is logged."""
    notifier.reloading()
    try:
        file = service.configured_file()
        changes = service.apply_file(await off_loop(lambda: load(file)))
    except ConfigurationError as error:
        for problem in error.problems:
            log.error("reload-refused %s", problem)
    except RequestError as error:
        log.error("reload-refused %s", error)
    except TimeoutError:
        log.error("reload-refused the files were not read within %g s", FILE_TIMEOUT_S)
    else:
        log.info("reloaded changes=%d %s", len(changes), "; ".join(changes))
    notifier.ready(_status(service))


def _status(service: Service) -> str:
    conditions = service.driver.conditions()
    online = sum(peer.online for peer in conditions.peers)
    return f"{service.settings.name}: {online} of {len(conditions.peers)} peers online"
