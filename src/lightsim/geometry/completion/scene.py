"""Inputs of the completion, and the scene that its steps build up."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from lightsim.core.buildings import Roofline, Wall
from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.fields import GroundMap
from lightsim.core.lidar_returns import LidarReturns
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import LidarSweep
from lightsim.geometry.completion.crowns import Beams, Crowns
from lightsim.geometry.completion.kerbs import Kerb, find_kerbs
from lightsim.geometry.completion.pitched_roofs import PitchedRoof
from lightsim.geometry.completion.view_evidence import ViewEvidence


@dataclass(frozen=True, eq=False)
class Inputs:
    """Views, beams and ground map, frame world; no step changes them.

    Args:
        evidence: the views of the log.
        returns: LiDAR returns from surfaces that do not move.
        sweeps: returns the whole LiDAR sweeps.
        ground: reference of heights.
        path_m: positions of the recording vehicle.
        make_caster: builds a ray caster.
        seed: seed of the positions of leaves.
    """

    evidence: ViewEvidence
    returns: LidarReturns
    sweeps: Callable[[], Iterable[LidarSweep]]
    ground: GroundMap
    path_m: Float64[np.ndarray, "k 3"]
    make_caster: MakeCaster
    seed: int = 0

    @cached_property
    def beams(self) -> Beams:
        """The beams except those that end on actors at rest."""
        is_used = ~self.returns.is_on_actor
        return Beams(self.returns.origins[is_used], self.returns.points[is_used])

    @cached_property
    def kerbs(self) -> list[Kerb]:
        """The height steps of the ground that follow the path."""
        return find_kerbs(self.returns.points, self.ground, self.path_m)


@dataclass(frozen=True, eq=False)
class Scene:
    """Static surfaces and the objects found in them, frame world.

    Args:
        background: static surfaces, outward faces counter-clockwise.
        crowns: foliage.
        walls: planes with measured surface (`walls.find_walls`).
        far_walls: walls known from returns alone.
        pitched_roofs: roofs with a measured slope.
        rooflines: upper edges of `walls` and `far_walls`.
        parked: vehicles at rest, which hide the surface behind them.
    """

    background: TriMesh
    crowns: Crowns
    walls: Sequence[Wall] = ()
    far_walls: Sequence[Wall] = ()
    pitched_roofs: Sequence[PitchedRoof] = ()
    rooflines: Sequence[Roofline] = ()
    parked: Sequence[TriMesh] = ()

    def caster(self, make_caster: MakeCaster, with_parked: bool = False) -> RayCaster:
        """Return a ray caster over the background, or over vehicles at rest as well."""
        return make_caster([self.background, *(self.parked if with_parked else ())])
