"""The daemon from start to stop.

1. Locks the state directory, opens the links, the local socket and the metrics port, then drops privileges.
2. Notifies systemd that the service is ready, then sends a watchdog keep-alive twice per period.
3. On SIGHUP, reads the configuration again; on SIGTERM or SIGINT, sends goodbyes, closes its files and exits.
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
from udp_mesh.daemon.directory_lock import DirectoryLock
from udp_mesh.daemon.file_access import FILE_TIMEOUT_S, off_loop
from udp_mesh.daemon.heap import map_large_blocks
from udp_mesh.daemon.listener import check_unused
from udp_mesh.daemon.metrics_server import MetricsServer
from udp_mesh.daemon.privileges import drop_privileges
from udp_mesh.daemon.sd_notify import Notifier
from udp_mesh.daemon.service import Service
from udp_mesh.daemon.toml_source import ConfigurationError
from udp_mesh.wire.limits import BOOT_ID_BYTES

log = logging.getLogger(__name__)

GC_THRESHOLDS = (20_000, 50, 50)
"""The transport creates few cycles; the default of 700 collects hundreds of times a second under load."""


async def run(configuration: Configuration) -> None:
    """Runs the daemon until SIGTERM or SIGINT. Raises OSError if it cannot start."""
    map_large_blocks()
    # both before it reads the state directory: that may be the other daemon's, which is writing there
    check_unused(configuration.daemon.socket)
    try:
        lock = DirectoryLock(configuration.daemon.state_directory)
    except OSError as error:
        raise OSError(f"{error} (change `state_directory` in [daemon])") from None
    try:
        await _run(configuration)
    finally:
        lock.release()


async def _run(configuration: Configuration) -> None:
    if configuration.settings.unkeyed:
        log.warning("UNKEYED traffic is not protected: anyone on the network can read, forge and inject messages")
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
            drop_privileges(daemon.user, (daemon.state_directory, *service.log_store.files))
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
    # For a daemon that hangs on a distant robot: SIGUSR1 logs all stacks.
    faulthandler.register(signal.SIGUSR1)
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GC_THRESHOLDS)
    notifier.ready(_status(service))
    log.info("ready name=%s port=%d boot=%s", service.settings.name, service.settings.port, service.boot_id.hex())
    if not service.driver.hub.links:
        log.warning("no-link no configured interface is up with an address; links will be opened when they appear")
    period_s = notifier.watchdog_s
    while not stop.is_set():
        try:
            async with asyncio.timeout(period_s):
                await stop.wait()
        except TimeoutError:
            notifier.alive(_status(service))


def _log_unhandled_error(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Logs an unexpected exception and keeps running: the robot's link matters more than a clean exit."""
    log.error("bug message=%s", context.get("message"), exc_info=context.get("exception"))


async def _reload(service: Service, notifier: Notifier) -> None:
    """On SIGHUP: reloads the configuration; a file with problems changes nothing and each problem is logged."""
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
        log.error("reload-refused timed out after %g s while reading the files", FILE_TIMEOUT_S)
    else:
        log.info("reloaded changes=%d %s", len(changes), "; ".join(changes))
    notifier.ready(_status(service))


def _status(service: Service) -> str:
    conditions = service.driver.conditions()
    online = sum(peer.online for peer in conditions.peers)
    return f"{service.settings.name}: {online} of {len(conditions.peers)} peers online"
