"""Sites: nodes, their meshes and the worker that provisions them (MC131 to MC139)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.addresses import as_address
from meshctl.lint.rules.references import suggest
from meshctl.lint.sshkey import BadKey, parse_authorized_key
from meshctl.model import Fleet, Node, Role
from meshctl.wording import join_limited

_FAR = """\
meshes: {far: {ssid: far, bssid: 02:ca:fe:00:00:02, band: 5g, channel: 36, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: FAR_KEY}}}
nodes:
  far1: {role: base, address: 10.43.0.1, label: F1, radios: {radio0: {mesh: null}, radio1: {mesh: far}}%s}
  far2: {role: beacon, address: 10.43.0.2, label: F2, radios: {radio0: {mesh: null}, radio1: {mesh: far}}%s}
"""
_KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8g worker"
_NORTH = f"{{ssh: {{host: north.example.org}}, worker_key: {_KEY}}}"
_SOUTH = f"{{ssh: {{host: south.example.org}}, worker_key: {_KEY}}}"


@fleet_rule(
    "MC131",
    Severity.ERROR,
    "A node is at a site that does not exist",
    why="No worker provisions the node, and the operator, who may not reach it, would try instead.",
    fix="Use a site defined in `sites`.",
    failing="""
    sites: {north: {}}
    nodes: {base: {site: north}, b01: {site: nort}}
    """,
    passing="""
    sites: {north: {}}
    nodes: {b01: {site: north}}
    """,
)
def unknown_site(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        if node.site and node.site not in fleet.sites:
            expected, hint = suggest(fleet.sites, node.site)
            yield Finding(("nodes", node.name, "site"), "no such site", expected, node.site, hint)


@fleet_rule(
    "MC132",
    Severity.ERROR,
    "A mesh has nodes at a site with a worker, and others elsewhere",
    why="""A change of a mesh is planned with all its nodes: which one cuts off which, and when the whole cell has met
    again. A worker has only the nodes of its site.""",
    fix="Set the same `site` for all nodes of the mesh, for example in their group.",
    failing=f"""
    sites: {{north: {_NORTH}, south: {_SOUTH}}}
    defaults: {{site: north}}
    nodes: {{b01: {{site: south}}}}
    """,
    passing=f"""
    sites: {{north: {_NORTH}}}
    defaults: {{site: north}}
    """,
)
def mesh_at_two_sites(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name in fleet.meshes:
        sites = group_by_key((node.site, node.name) for node in fleet.members(name))
        if len(sites) > 1 and any(site.has_worker for key in sites if (site := fleet.sites.get(key)) is not None):
            found = "; ".join(f"{key or 'no site'}: {join_limited(nodes)}" for key, nodes in sites.items())
            yield Finding(("meshes", name), "its nodes are not at one site", "all nodes at one site", found)


@fleet_rule(
    "MC133",
    Severity.WARNING,
    "A site has no nodes",
    why="A site without nodes is usually a leftover, or its nodes lack `site`.",
    fix="Set `site` at its nodes or in their group, or remove the site.",
    failing="sites: {north: {}}",
    passing="""
    sites: {north: {}}
    nodes: {b01: {site: north}}
    """,
)
def empty_site(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    used = {node.site for node in fleet.managed()}
    for name in fleet.sites:
        if name not in used:
            yield Finding(("sites", name), "no managed node is at this site", "at least one node", "none")


@fleet_rule(
    "MC134",
    Severity.ERROR,
    "A node's jump host is at another site",
    why="The worker of a site knows only the nodes of its site, so it cannot connect through this one.",
    fix="Name a jump host of the same site, or remove `ssh.jump`: the worker is at the site.",
    failing=f"""
    sites: {{north: {_NORTH}, south: {_SOUTH}}}
    defaults: {{site: north}}
    meshes: {{far: {{ssid: far, band: 5g, channel: 36, network: 10.43.0.0/24, encryption: sae, mode: mesh,
                   key: {{env: MESH_KEY}}}}}}
    nodes:
      b01: {{ssh: {{jump: far}}}}
      far: {{site: south, role: base, state: deployed, address: 10.43.0.1, label: FAR, mac: "00:15:6d:00:00:09",
            host_keys: [{_KEY}], radios: {{radio0: {{mesh: null}}, radio1: {{mesh: far}}}}}}
    """,
    passing=f"""
    sites: {{north: {_NORTH}}}
    defaults: {{site: north}}
    nodes: {{b01: {{ssh: {{jump: base}}}}}}
    """,
)
def jump_to_other_site(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        jump = fleet.nodes.get(node.ssh.jump)
        if jump is not None and jump.site != node.site and fleet.worker_site(node) is not None:
            expected = f"a node at {node.site}"
            found = f"{jump.name}, at {jump.site or 'no site'}"
            yield Finding(("nodes", node.name, "ssh", "jump"), "a node at another site", expected, found)


@fleet_rule(
    "MC135",
    Severity.WARNING,
    "A site's nodes do not accept its worker",
    why="Without `worker_key` the worker can log in only if its gateway has a key of an operator.",
    fix="Run `meshctl sites install NAME`, which generates a key there and writes its public part here.",
    failing="""
    sites: {north: {ssh: {host: north.example.org}}}
    defaults: {site: north}
    """,
    passing=f"""
    sites: {{north: {_NORTH}}}
    defaults: {{site: north}}
    """,
)
def worker_without_key(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name, site in fleet.sites.items():
        if site.has_worker and not site.worker_key:
            yield Finding(("sites", name), "no worker_key", "the worker's SSH public key", "none")


@fleet_rule(
    "MC136",
    Severity.ERROR,
    "A site's worker key is not a public key",
    why="dropbear silently skips a line that it cannot read: after the change, the worker is locked out.",
    fix="Run `meshctl sites install NAME` again, or copy the whole line that it prints.",
    failing="""
    sites: {north: {ssh: {host: north.example.org}, worker_key: ssh-ed25519 AAAAC3NzaC1lZDI1NTE5}}
    defaults: {site: north}
    """,
    passing=f"""
    sites: {{north: {_NORTH}}}
    defaults: {{site: north}}
    """,
)
def worker_key_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name, site in fleet.sites.items():
        if site.worker_key:
            try:
                parse_authorized_key(site.worker_key)
            except BadKey as reason:
                yield Finding(("sites", name, "worker_key"), "", "an SSH public key", str(reason))


@fleet_rule(
    "MC137",
    Severity.ERROR,
    "A site uses NATS, and the fleet has no hub",
    why="Orders for the site have no server to wait at, so its permanent worker cannot be reached.",
    fix="Set `nats.url` to the address of the hub, or remove `nats` from the site.",
    failing=f"""
    sites: {{north: {{nats: {{}}, worker_key: {_KEY}}}}}
    defaults: {{site: north}}
    """,
    passing=f"""
    nats: {{url: "tls://hub.example.org:4222"}}
    sites: {{north: {{nats: {{}}, worker_key: {_KEY}}}}}
    defaults: {{site: north}}
    """,
)
def nats_without_hub(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name, site in fleet.sites.items():
        if site.nats is not None and fleet.nats is None:
            yield Finding(("sites", name, "nats"), "the fleet has no NATS hub", "`nats.url` in the inventory", "none")


@fleet_rule(
    "MC138",
    Severity.WARNING,
    "A base leads to a mesh of its own without a site",
    why="""Of several bases, status and plans start from the first one of each site. Nodes in a mesh that this base does
    not reach are reported without a path, and plans cannot determine what a change disconnects.""",
    fix="Define a site for each such base in `sites`, and set it for the nodes of its meshes.",
    failing=_FAR % ("", ""),
    passing="sites: {far: {}}\n" + _FAR % (", site: far", ", site: far"),
)
def base_of_another_mesh(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for first in fleet.base_nodes:
        reached = _joined_meshes(fleet, first)
        for node in fleet.managed():
            is_other = node.role is Role.BASE and node.site == first.site and bool(node.meshes)
            if is_other and not reached.intersection(node.meshes):
                found = f"{first.name} is the base, and does not reach {join_limited(node.meshes)}"
                yield Finding(("nodes", node.name, "role"), found, "a site of its own", node.site or "no site")


def _joined_meshes(fleet: Fleet, base: Node) -> set[str]:
    """The meshes that the base reaches: those of its radios, and any that a node or a robot's nodes join to these."""
    groups = [set(node.meshes) for node in fleet.managed()]
    for robot in fleet.robots.values():
        groups.append({mesh for name in robot.nodes if name in fleet.nodes for mesh in fleet.nodes[name].meshes})
    reached = set(base.meshes)
    while new := {mesh for group in groups if group & reached for mesh in group} - reached:
        reached |= new
    return reached


@fleet_rule(
    "MC139",
    Severity.ERROR,
    "A site's gateway is a radio",
    why="""The gateway is the computer that runs the site's worker, which needs Python. A radio runs OpenWrt, which has
    none.""",
    fix="Set `ssh.host` to the computer at the site.",
    failing=f"""
    sites: {{north: {{ssh: {{host: 10.42.0.1}}, worker_key: {_KEY}}}}}
    defaults: {{site: north}}
    """,
    passing=f"""
    sites: {{north: {{ssh: {{host: 10.42.0.100}}, worker_key: {_KEY}}}}}
    defaults: {{site: north}}
    """,
)
def gateway_is_radio(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    radios = {as_address(str(node.address.ip)): node.name for node in fleet.managed()}
    for site in fleet.sites.values():
        radio = radios.get(as_address(site.ssh.host))
        if radio is not None:
            path = ("sites", site.name, "ssh", "host")
            yield Finding(path, f"{radio} is a radio", "the computer at the site", site.ssh.host)
