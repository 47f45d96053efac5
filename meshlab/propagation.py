"""The radio environment of a fleet: positions, walls and propagation -> links.

`links_of`: one LinkSpec for each pair of which at least one hears the other. Explicit links replace the computed ones.
The models of propagation are in `meshctl.placement.path_loss`, which plans with them, too.

Pure; `propagation_file` reads and writes the files. A moving fleet is a sequence of `RadioEnvironment`s.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from types import MappingProxyType

from meshctl.errors import InputError
from meshctl.placement.ground import STANDARD_AIR, NodePosition
from meshctl.placement.path_loss import Point, RadioModel, Wall, walls_between
from meshlab.spec import LinkSpec


@dataclass(frozen=True, slots=True)
class RadioEnvironment:
    """`positions` by node name; `links` are the explicit ones, each pair at most once."""

    positions: Mapping[str, NodePosition] = field(default_factory=lambda: MappingProxyType({}))
    walls: tuple[Wall, ...] = ()
    path_loss: RadioModel = STANDARD_AIR
    links: tuple[LinkSpec, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every node with a position or an explicit link, sorted."""
        return tuple(sorted({*self.positions, *(name for link in self.links for name in link.ends)}))

    def with_moved(self, name: str, to: Point) -> RadioEnvironment:
        """The same environment with a node moved. Raises InputError for a node without a position."""
        if name not in self.positions:
            places = ", ".join(self.positions)
            raise InputError(
                f"cannot move {name}: it has no position",
                hint=f"nodes with a position: {places}" if places else "load positions with `meshctl lab ground FILE`",
            )
        return replace(self, positions={**self.positions, name: replace(self.positions[name], at=to)})


def links_of(environment: RadioEnvironment) -> tuple[LinkSpec, ...]:
    """A link for each pair of which at least one hears the other, sorted by name; then the explicit links."""
    found = [
        link
        for a, b, strengths in received_dbm(environment, environment.positions)
        if (link := _link(environment.path_loss, a, b, strengths)) is not None
    ]
    return (*found, *environment.links)


def received_dbm(environment: RadioEnvironment, names: Iterable[str]) -> Iterator[tuple[str, str, tuple[float, float]]]:
    """Each pair of these nodes without an explicit link, sorted by name, with the power of the first at the second and
    of the second at the first."""
    explicit, model = {link.ends for link in environment.links}, environment.path_loss
    for a, b in combinations(sorted(names), 2):
        if frozenset((a, b)) in explicit:
            continue
        first, second = environment.positions[a], environment.positions[b]
        distance_m = math.dist(first.at, second.at)
        walls = walls_between(environment.walls, first.at, second.at)
        there, back = (
            model.power_dbm(distance_m, model.tx_power_dbm if own is None else own, walls)
            for own in (first.tx_power_dbm, second.tx_power_dbm)
        )
        yield a, b, (there, back)


def _link(model: RadioModel, a: str, b: str, strengths: tuple[float, float]) -> LinkSpec | None:
    there, back = (model.loss(strength) for strength in strengths)
    if there >= 1.0 and back >= 1.0:
        return None
    return LinkSpec(
        a,
        b,
        signal_dbm=round(strengths[0]),
        loss=there,
        loss_back=None if back == there else back,
        signal_back_dbm=None if strengths[0] == strengths[1] else round(strengths[1]),
    )
