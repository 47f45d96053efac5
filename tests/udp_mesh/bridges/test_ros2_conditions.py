"""The typed conditions in a real ROS 2, with the package built as its generators do: read by a node, with what a
collector measured; not published where another version of the package is built."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.udp_mesh.bridges.ros2_processes import Ros2Bridge, Ros2Node, build_messages, expects_ros2
from tests.udp_mesh.bridges.test_conditions_message import NEIGHBOR, RADIO_PATH
from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons
from udp_mesh.bridges.conditions_message import FOLDER

pytestmark = [
    pytest.mark.proof,
    pytest.mark.xdist_group("ros2"),
    pytest.mark.skipif(not expects_ros2(), reason="needs scripts/setup-ros2"),
]
DOMAIN = 78
TYPED = "/alice/mesh_conditions_typed"
TYPE = "udp_mesh_msgs/msg/Conditions"
PATH = {**RADIO_PATH, "peer": "bob", "trend": "worsening", "change_db_per_s": -0.5}
REPORT = json.dumps({"source": "alice-radio", "paths": [PATH], "neighbors": [NEIGHBOR]}).encode()


@contextmanager
def robot(built: Path) -> Iterator[tuple[RunningDaemon, Ros2Bridge, Ros2Node]]:
    with two_daemons() as (alice, _), ExitStack() as kept:
        bridge = Ros2Bridge(alice, DOMAIN, built=built)
        kept.callback(bridge.stop)
        bridge.start()
        node = Ros2Node(alice.folder, "reader", DOMAIN, built=built)
        kept.callback(node.close)
        yield alice, bridge, node


def test_a_node_reads_what_the_collector_measured(tmp_path: Path) -> None:
    build_messages(FOLDER, tmp_path / "built")
    with robot(tmp_path / "built") as (alice, _, node), alice.client() as client:
        node.subscribe(TYPED, type=TYPE, parsed=True)

        def read() -> str | None:
            client.request("set-radio", REPORT)
            text = str(node.expect("name", TYPED)["data"])
            return text if "next_hop='b02'" in text else None

        text = poll(read, "the radio path")
    path, neighbors = text.split("udp_mesh_msgs.msg.RadioConditions(")
    assert "name='bob', online=True" in path
    assert "margin_db=11.5" in path
    assert "quality=nan, trend=3, change_db_per_s=-0.5" in path
    assert "name='b03', radio='alice-radio', signal_dbm=-80.5, margin_db=nan" in neighbors


def test_nothing_is_published_in_a_type_with_other_fields(tmp_path: Path) -> None:
    earlier = tmp_path / "earlier" / FOLDER.name
    shutil.copytree(FOLDER, earlier)
    peer = earlier / "msg" / "PeerConditions.msg"
    peer.write_text(peer.read_text().replace("udp_mesh_msgs/RadioPath radio\n", ""))
    build_messages(earlier, tmp_path / "built")
    with robot(tmp_path / "built") as (_, bridge, node):
        node.subscribe(TYPED, type=TYPE)
        node.subscribe("/alice/mesh_conditions")
        reason = "the source has another definition of the type: not published"
        poll(lambda: reason in bridge.log.read_text(), "the bridge's reason")
        # the JSON still is
        assert "bob" in node.expect("name", "/alice/mesh_conditions")["data"]
        assert [line for line in node.received() if line["name"] == TYPED] == []
