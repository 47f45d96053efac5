"""A camera that adapts to a real link: two daemons in networks of their own, a bridge's runtime, and no ROS."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from io import BytesIO
from itertools import islice, pairwise
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
MAX_IMAGES = 400
"""Until the detail has fallen or risen: some ten images, and a busy host delays more."""
SETTLED_IMAGES = 40
OPTIONS = JpegOptions(60, 5)
SWING = 0.25
"""Of the detail, down or up: several steps, more than what follows from one late image."""
RISE = 0.1


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


def swings(details: Sequence[float]) -> int:
    """How often the detail turned, after it had moved by SWING or more."""
    found, direction, extreme = 0, 0, details[0]
    for detail in details:
        if (detail - extreme) * direction > 0:
            extreme = detail
        elif abs(detail - extreme) >= SWING:
            found += direction != 0
            direction, extreme = (1 if detail > extreme else -1), detail
    return found


def coarseness(jpeg: Image.Image) -> int:
    """The sum of its quantization table: the larger, the lower the quality."""
    return sum(jpeg.quantization[0])  # type: ignore[attr-defined]


def coarseness_at(quality: int) -> int:
    file = BytesIO()
    Image.new("RGB", (8, 8)).save(file, "JPEG", quality=quality)
    return coarseness(Image.open(file))


def test_swings_are_counted_and_steps_are_not() -> None:
    assert swings([1.0, 0.9, 0.5, 0.4, 0.45, 0.4, 0.5, 0.4]) == 0
    assert swings([1.0, 0.5, 0.8, 0.4, 0.9]) == 3


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
        reduction = Reduction(RATE_HZ, OPTIONS, adapt=True)
        runtime, reducer = kept.enter_context(bridge(daemons[0].socket, reduction))
        key, raw = TypeKey(IMAGE, TYPES[IMAGE].md5sum), frame()
        found: list[int] = []

        def film() -> Iterator[float]:
            """The detail after each image."""
            for _ in range(MAX_IMAGES):
                runtime.from_ros(Route("camera", "bob"), "/camera", key, "", False, raw)
                for message in base.messages(1 / RATE_HZ):
                    image = Image.open(BytesIO(decode(TYPES[JPEG], message.payload, 1)["data"].data))
                    assert image.size == SIZE
                    found.append(coarseness(image))
                time.sleep(0.01)
                yield reducer.detail("camera")

        assert reducer.detail("camera") == 1.0
        assert any(detail < 0.8 for detail in film()), "the detail does not fall"
        # a busy host delays images, too: it may push the detail down once, and that comes back
        settled = list(islice(film(), SETTLED_IMAGES))
        assert swings(settled) <= 2, settled
        lab.set(rate=5e6)
        risen = [reducer.detail("camera")]
        for detail in film():
            risen.append(detail)
            if detail > risen[0] + RISE:
                break
        assert risen[-1] > risen[0] + RISE, "the detail does not rise"
        assert max(later - sooner for sooner, later in pairwise(risen)) <= MAX_INCREASE + 1e-9
        # what arrived was of the quality that was decided, within its bounds
        best, worst = coarseness_at(OPTIONS.quality), coarseness_at(OPTIONS.min_quality)
        assert best <= min(found) < max(found) <= worst
