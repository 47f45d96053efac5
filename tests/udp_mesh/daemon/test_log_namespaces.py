"""Daemons with a shared log that meet for five seconds each, in network namespaces of their own."""

from tests.udp_mesh.daemon.veth_links import run_as_root


def test_every_artifact_arrives_once_through_a_carrier_that_meets_each_for_five_seconds() -> None:
    run_as_root("tests.udp_mesh.daemon.log_namespaces")
