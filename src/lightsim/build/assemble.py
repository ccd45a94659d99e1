"""Assembly and checks of a digital twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lightsim.appearance.colour import colour_of_nearest
from lightsim.core.buildings import Roofline
from lightsim.core.casting import RayCaster
from lightsim.core.dome import Sun
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.twin import DigitalTwin, SceneAssets, SkyEstimate
from lightsim.errors import FrameMismatchError, InputError
from lightsim.geometry.completion.prisms import unobserved_building_parts
from lightsim.geometry.completion.rooflines import height_prior, tops_at
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.roofs import UncertainRoofs

# Number of sampled height profiles of unobserved roofs. A shadow of uncertain length has as many
# steps. Chosen; sensitivity not measured.
_GUESSES = 8


def roofs_over(background: TriMesh, rooflines: Sequence[Roofline]) -> TriMesh:
    """Return the inferred roofs and rear walls, in the colours of the nearest background."""
    casters = unobserved_building_parts(rooflines, background, make_caster=make_embree_caster)
    return colour_of_nearest(casters, background)


def uncertain_roofs(
    background: TriMesh, rooflines: Sequence[Roofline], recorded_sun: Sun | None
) -> UncertainRoofs | None:
    """Return samples of the inferred roofs for light from other directions than the recorded sun's;
    None if views show every roof edge. `roofs_over` returns the most probable roofs alone."""
    if all(r.is_seen.all() for r in rooflines):
        return None

    def shapes() -> list[RayCaster]:
        prior = height_prior(rooflines)
        # Quantiles at the middles of equal parts of the probability: all samples weigh alike.
        levels = (np.arange(_GUESSES) + 0.5) / _GUESSES
        tops = [tops_at(r, prior, levels) for r in rooflines]
        # One caster of the background serves all samples.
        caster = make_embree_caster([background])
        return [
            make_embree_caster(
                [unobserved_building_parts(shape, background, make_caster=lambda _: caster)]
            )
            for shape in (
                [replace(r, top=top[k]) for r, top in zip(rooflines, tops, strict=True)]
                for k in range(_GUESSES)
            )
        ]

    return UncertainRoofs(shapes, recorded_sun)


def build_twin(log: DrivingLog, assets: SceneAssets, sky: SkyEstimate) -> DigitalTwin:
    """Join the parts of a digital twin.

    Raises:
        InputError: no background surface, a camera without gain, or a base colour out of [0, 1].
        FrameMismatchError: a mesh is in the wrong frame.
    """
    if len(assets.background.faces) == 0:
        raise InputError(
            "the background has no surface",
            where=log.name,
            remedy="Check that the log has LiDAR sweeps in the chosen frames.",
        )
    # Checked here once: each renderer would otherwise fail in its own way.
    missing = [name for name in log.cameras if name not in assets.camera_gains]
    if missing:
        raise InputError(
            "cameras have no gain",
            where=log.name,
            got=f"none for {', '.join(missing)}",
            expected="one for every camera of the log",
        )
    meshes = [("background", assets.background, "world")]
    meshes += [(a.actor_id, a.mesh, "actor") for a in assets.actors.values()]
    for name, mesh, frame in meshes:
        if mesh.frame != frame:
            raise FrameMismatchError(
                "a mesh is in the wrong frame", where=name, got=mesh.frame, expected=frame
            )
        colour = mesh.base_colour
        if not np.isfinite(colour).all() or (colour < 0).any() or (colour > 1).any():
            raise InputError(
                "the base colour is out of range",
                where=name,
                got=f"{colour.min():g} to {colour.max():g}",
                expected="finite values in [0, 1]",
            )
    return DigitalTwin(log, assets, sky)
