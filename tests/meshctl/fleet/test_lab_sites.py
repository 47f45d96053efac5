"""A lab's copy of an inventory names the real sites' gateways, which practice must not reach."""

from collections.abc import Mapping
from pathlib import Path

from meshctl.fleet.lab_sites import without_real_gateways
from meshctl.inventory import load_fleet
from meshctl.model import Site

_INVENTORY = """
meshctl: 1
fleet: mines
country: US
nats: {{url: "{hub}"}}
sites:
  north: {{ssh: {{host: north.example.org, user: mesh}}, nats: {{}}}}
  south: {{ssh: {{host: 127.0.0.1, port: 2222, user: mesh}}, nats: {{}}}}
  over-nats: {{ssh: {{key_files: [key]}}, nats: {{}}}}
  label: {{}}
"""


def _lab_sites(directory: Path, hub: str) -> Mapping[str, Site]:
    path = directory / "fleet.yaml"
    path.write_text(_INVENTORY.format(hub=hub))
    return without_real_gateways(load_fleet(path, environ={})).sites


def _reached(sites: Mapping[str, Site]) -> dict[str, tuple[str, bool]]:
    return {name: (site.ssh.host, site.nats is not None) for name, site in sites.items()}


def test_in_a_lab_only_gateways_and_hubs_on_this_machine_are_used(tmp_path: Path) -> None:
    assert _reached(_lab_sites(tmp_path, "tls://hub.example.org:4222")) == {
        "north": ("", False),
        "south": ("127.0.0.1", False),
        "over-nats": ("", False),
        "label": ("", False),
    }
    assert _reached(_lab_sites(tmp_path, "nats://127.0.0.1:4222"))["north"] == ("", True)


def test_the_key_files_of_orders_over_nats_stay(tmp_path: Path) -> None:
    assert _lab_sites(tmp_path, "nats://127.0.0.1:4222")["over-nats"].ssh.key_files == ("key",)
