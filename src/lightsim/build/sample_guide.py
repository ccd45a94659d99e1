"""Guide that places the samples on the rays of the neural field."""

from __future__ import annotations

from lightsim.core.fields import SceneFields
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.geometry.surface import background_levels, extract_surface
from lightsim.progress import Progress
from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.reconstruct.field.occupancy import Occupancy
from lightsim.reconstruct.field.ray_pool import Guide, PriorSurfaces
from lightsim.render.casters.embree import make_embree_caster


def sample_guide(
    log: DrivingLog, fields: SceneFields, config: NeuralConfig, progress: Progress
) -> Guide:
    """Return the guide of a field's samples.

    A field that learns a residual is sampled near the meshes of the fused LiDAR, any other one in
    the cells that contain LiDAR returns.
    """
    if not config.has_prior:
        return Occupancy.of_returns(log, fields.path_m, fields.background_radius_m[-1], progress)
    # Casters accept frame `world` only. Rays are transformed into the frame of each actor, so that
    # its mesh is relabelled without being moved. Cells up to a weight of 0.03 count as unobserved;
    # chosen, sensitivity not measured.
    at_origin = RigidTransform.identity("world", "actor")
    return PriorSurfaces(
        make_embree_caster(background_levels(fields, 0.03)),
        {
            actor_id: make_embree_caster([extract_surface(grid, 0.03).transformed(at_origin)])
            for actor_id, grid in fields.actors.items()
        },
    )
