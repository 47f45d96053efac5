"""A camera that adapts to a real link: two daemons in networks of their own, a bridge's runtime, and no ROS."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy
import pytest
from PIL import Image

from benchmarks.link.laboratory import Link, laboratory
from tests.udp_mesh.bridges.ros_team import RobotsDaemon
from tests.udp_mesh.daemon.processes import RATES, wait_online
from udp_mesh.bridges.daemon_client import DaemonClient
from udp_mesh.bridges.message_codec import Numbers, decode, encode
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.names import Route
from udp_mesh.bridges.receiving import EVERYTHING
from udp_mesh.bridges.reduction import IMAGE, JPEG, MAX_INCREASE, JpegOptions, Reducer, Reduction
from udp_mesh.bridges.relay import PROTOCOL_TOPICS, Relay
from udp_mesh.bridges.runtime import BridgeRuntime
from udp_mesh.bridges.types import TypeKey

pytestmark = pytest.mark.lab

TOPICS = """
[topics]
camera = { priority = 9, keep_last = 1 }
"""
LINK = Link(rate=0.2e6, delay_ms=5.0, loss=0.01)
RATE_HZ, SIZE = 4.0, (160, 120)
IMAGES = 60
"""Two thirds of them to settle: a fall takes some ten, and a busy host delays some more."""


@contextmanager
def bridge(socket: Path, reduction: Reduction) -> Iterator[tuple[BridgeRuntime, Reducer]]:
    reducer = Reducer({"camera": reduction}, 1)
    daemon = DaemonClient(str(socket), EVERYTHING)
    relay = Relay("alice", PROTOCOL_TOPICS[1], ros_version=1, nonce=b"nonce")
    runtime = BridgeRuntime(daemon, relay, lambda message: None, None, reducer)
    stop, up = threading.Event(), threading.Event()

    def connected() -> None:
        runtime.on_daemon_up()
        up.set()

    thread = threading.Thread(target=daemon.run, args=(stop, connected, runtime.on_frame))
    thread.start()
    try:
        assert up.wait(30.0)
        yield runtime, reducer
    finally:
        stop.set()
        thread.join(30.0)


def frame() -> bytes:
    """Noise: a JPEG of it at quality 60 takes half a second on the link, twice the period."""
    pixels = numpy.random.default_rng(1).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=numpy.uint8)
    message = {"width": SIZE[0], "height": SIZE[1], "encoding": "rgb8", "step": 3 * SIZE[0]}
    return encode(TYPES[IMAGE], {**message, "data": Numbers("B", pixels.tobytes())}, 1)


def test_the_quality_of_a_camera_settles_at_what_the_link_carries() -> None:
    with (
        tempfile.TemporaryDirectory(prefix="udp-mesh-") as path,
        laboratory(2, link=LINK) as lab,
        ExitStack() as kept,
    ):
        daemons = [
            RobotsDaemon(Path(path), name, lab.inside(place, []), TOPICS, RATES)
            for place, name in enumerate(("alice", "bob"))
        ]
        for daemon in daemons:
            kept.enter_context(daemon)
        wait_online(daemons[0], "bob")
        base = kept.enter_context(daemons[1].client())
        base.subscribe("camera")
        reduction = Reduction(RATE_HZ, JpegOptions(60, 5), adapt=True)
        runtime, reducer = kept.enter_context(bridge(daemons[0].socket, reduction))
        key, raw = TypeKey(IMAGE, TYPES[IMAGE].md5sum), frame()
        details, sizes = [], []
        for number in range(2 * IMAGES):
            if number == IMAGES:
                lab.set(rate=5e6)
            runtime.from_ros(Route("camera", "bob"), "/camera", key, "", False, raw)
            for message in base.messages(1 / RATE_HZ):
                data = decode(TYPES[JPEG], message.payload, 1)["data"].data
                assert Image.open(BytesIO(data)).size == SIZE
                sizes.append(len(data))
            time.sleep(0.01)
            details.append(reducer.detail("camera"))
        settled = details[IMAGES * 2 // 3 : IMAGES]
        assert details[0] == 1.0
        # without oscillating: a range of a few steps; how far down depends on the host, too, which delays images
        assert max(settled) < min(0.8, min(settled) + 0.3)
        # and rises again, in small steps, when the link carries more
        risen = details[IMAGES:]
        assert max(risen) > max(settled)
        # a busy host delays images, too, so detail may fall in between
        assert max(later - sooner for sooner, later in pairwise(risen)) <= MAX_INCREASE + 1e-9
        assert len(sizes) > 1.4 * IMAGES
