"""Daemons follow changes of interfaces and addresses, IPv4 or IPv6, during transfers."""

import pytest

from tests.udp_mesh.daemon.namespaces import SCENARIOS
from tests.udp_mesh.daemon.veth_links import run_as_root


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_daemons_follow_interface_and_address_changes(scenario: str) -> None:
    run_as_root("tests.udp_mesh.daemon.namespaces", scenario)
