"""Daemons follow changes of interfaces and addresses, IPv4 or IPv6, during transfers."""

import pytest

from tests.udp_mesh.daemon.namespaces import SCENARIOS
from tests.udp_mesh.daemon.veth_links import run_as_root


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_daemons_follow_interface_and_address_changes(scenario: str) -> None:
    run_as_root("tests.udp_mesh.daemon.namespaces", scenario)


def test_a_transfer_moves_between_two_radios_as_one_and_then_the_other_is_cut() -> None:
    run_as_root("tests.udp_mesh.daemon.two_radios")
