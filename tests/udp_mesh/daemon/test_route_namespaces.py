"""Daemons find the MTU of a route whose middle link carries less than their own links."""

import pytest

from tests.udp_mesh.daemon.route_namespaces import SCENARIOS
from tests.udp_mesh.daemon.veth_links import run_as_root


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_daemons_find_the_mtu_of_a_narrow_route(scenario: str) -> None:
    run_as_root("tests.udp_mesh.daemon.route_namespaces", scenario)
