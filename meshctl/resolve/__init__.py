"""Fleet -> Intent of each node: its complete desired configuration, as input for templates."""

from meshctl.resolve.airtime import originator_airtime
from meshctl.resolve.intent import Backbone, BatmanInterface, Intent, Lan, Login, MeshInterface, RadioIntent
from meshctl.resolve.intervals import (
    LONGEST_MEASURED_MS,
    MEASURED_HEAL_S,
    Intervals,
    UnreachableTarget,
    batman_intervals,
    heal_s,
)
from meshctl.resolve.node import resolve, resolve_unchecked
from meshctl.resolve.packages import (
    FULL_SUPPLICANTS,
    PackageNeed,
    PackagePlan,
    lan_filter_needs,
    package_files,
    package_needs,
    package_plan,
    supplicant_need,
    wireless_scripts,
)
from meshctl.resolve.routes import StaticRoute, computer_gateway, has_routed_lans, routes

__all__ = [
    "FULL_SUPPLICANTS",
    "LONGEST_MEASURED_MS",
    "MEASURED_HEAL_S",
    "Backbone",
    "BatmanInterface",
    "Intent",
    "Intervals",
    "Lan",
    "Login",
    "MeshInterface",
    "PackageNeed",
    "PackagePlan",
    "RadioIntent",
    "StaticRoute",
    "UnreachableTarget",
    "batman_intervals",
    "computer_gateway",
    "has_routed_lans",
    "heal_s",
    "lan_filter_needs",
    "originator_airtime",
    "package_files",
    "package_needs",
    "package_plan",
    "resolve",
    "resolve_unchecked",
    "routes",
    "supplicant_need",
    "wireless_scripts",
]
