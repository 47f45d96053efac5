"""A program of another vendor in a ROS 2 graph: Cyclone DDS without ROS, with ROS 2's names and type (std_msgs/String).

    python cyclone_program.py publish|subscribe ROS_TOPIC DOMAIN

It publishes ten times a second, or prints what it receives. It runs in the Python that has cyclonedds.
"""

import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

LOOPBACK_ONLY = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="localhost"/></Peers></Discovery>
</Domain></CycloneDDS>"""
"""As rmw_cyclonedds does for ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST."""


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):  # type: ignore[misc, call-arg, unused-ignore]
    data: str


def main(role: str, name: str, domain_id: int) -> None:
    domain = Domain(domain_id, LOOPBACK_ONLY)
    participant = DomainParticipant(domain_id)
    quality = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10))
    topic = Topic(participant, "rt" + name, String)
    if role == "publish":
        writer = DataWriter(participant, topic, qos=quality)
        while True:
            writer.write(String("of another vendor"))
            time.sleep(0.1)
    reader = DataReader(participant, topic, qos=quality)
    for sample in reader.take_iter(timeout=duration(infinite=True)):
        sys.stdout.write(f"heard {getattr(sample, 'data', '')}\n")
        sys.stdout.flush()
    del domain


main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
