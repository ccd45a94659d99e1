"""What guides the denoiser of path-traced pictures: the true surfaces, whatever the light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.stats import qmc

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim_lab.synthetic.geometry import Snapshot

_LOG2_RAYS = 4


@dataclass(frozen=True, eq=False)
class Guides:
    """Means over each pixel's area; 0 where it sees no surface."""

    base_colour: Float32[np.ndarray, "h w 3"]
    normal_world: Float32[np.ndarray, "h w 3"]
    """The faces' own, turned to the camera; shorter than 1 where a pixel sees several."""


def render_guides(
    snapshot: Snapshot, camera: PinholeCamera, world_from_camera: RigidTransform
) -> Guides:
    """Anti-aliased base colour and normals of what a camera sees."""
    h, w = camera.height_px, camera.width_px
    centres = camera.pixel_centres().reshape(-1, 2)
    origins = np.broadcast_to(world_from_camera.translation_m, (h * w, 3)).copy()
    colour, normal = np.zeros((h * w, 3)), np.zeros((h * w, 3))
    offsets = _offsets_px()
    for offset in offsets:
        directions = world_from_camera.rotate(camera.directions(centres + offset))
        hits = snapshot.intersect(origins, directions)
        colour += snapshot.base_colour(hits)
        normal += hits.normal_world
    mean = (np.stack([colour, normal]) / len(offsets)).reshape(2, h, w, 3).astype(np.float32)
    return Guides(mean[0], mean[1])


def _offsets_px() -> Float[np.ndarray, "n 2"]:
    """From a pixel's centre, the same in every pixel. Sobol's points are each alone in their row
    and column: an upright edge is seen in as many steps as there are rays."""
    points = qmc.Sobol(2, scramble=False).random_base2(_LOG2_RAYS)
    return points + 0.5 / len(points) - 0.5
