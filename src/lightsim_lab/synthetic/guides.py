"""Guide images of the denoiser for path-traced images: true base colour and normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy.stats import qmc

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim_lab.synthetic.geometry import Snapshot

# Base-2 logarithm of the rays per pixel: 16, for smooth edges.
_LOG2_RAYS = 4


@dataclass(frozen=True, eq=False)
class Guides:
    """Means over the area of each pixel; 0 without a surface."""

    base_colour: Float32[np.ndarray, "h w 3"]
    normal_world: Float32[np.ndarray, "h w 3"]
    """Face normals towards the camera; their mean is shorter than 1 where several faces meet."""


def render_guides(
    snapshot: Snapshot, camera: PinholeCamera, world_from_camera: RigidTransform
) -> Guides:
    """Render anti-aliased base colour and normals of a camera view."""
    h, w = camera.height_px, camera.width_px
    centres = camera.pixel_centres().reshape(-1, 2)
    origins = np.broadcast_to(world_from_camera.translation_m, (h * w, 3)).copy()
    colour, normal = np.zeros((h * w, 3)), np.zeros((h * w, 3))
    # Hits without a surface contribute 0 to the means.
    offsets = _offsets_px()
    for offset in offsets:
        directions = world_from_camera.rotate(camera.directions(centres + offset))
        hits = snapshot.intersect(origins, directions)
        colour += snapshot.base_colour(hits)
        normal += hits.normal_world
    mean = (np.stack([colour, normal]) / len(offsets)).reshape(2, h, w, 3).astype(np.float32)
    return Guides(mean[0], mean[1])


def _offsets_px() -> Float[np.ndarray, "n 2"]:
    """Return the offsets of the rays from the pixel centre, equal in every pixel.

    Sobol points differ in all rows and columns, so that a vertical or horizontal edge gets as many
    grey levels as there are rays.
    """
    points = qmc.Sobol(2, scramble=False).random_base2(_LOG2_RAYS)
    return points + 0.5 / len(points) - 0.5
