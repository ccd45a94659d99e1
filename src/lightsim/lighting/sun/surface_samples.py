"""Points of the reconstructed surfaces, with their observed radiance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import KDTree

from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.colour import luminance
from lightsim.core.mesh import Provenance, TriMesh

# Surfaces of inferred shape: they cast shadows, but no points are sampled on them.
_UNMEASURED = (Provenance.INFERRED, Provenance.BACKGROUND_PROXY)

# Chosen on streets 0 and 1 and log 002; measured only in combination
# (docs/benchmarks/lighting.md).

# Offset of ray origins from their surface, in metres, so that rays do not hit bumps of its mesh.
RAY_OFFSET_M = 0.08
# Largest distance of points to the path of the cameras, in metres.
_REACH_M = 35.0
# Confidence of the base colour, at least; lower ones are extrapolated colours.
_MIN_CONFIDENCE = 0.5


@dataclass(frozen=True)
class SampleConfig:
    """Number of surface points and of their rays."""

    point_count: int = 4000
    """Approximate number of surface points, distributed in proportion to area."""
    sky_rays: int = 32
    """Cosine-weighted rays per point that measure its sky view factor."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points of surfaces in frame `world`.

    Args:
        log_radiance: natural logarithm of the observed luminance.
        material: class of the surface.
        sky_view_factor: sky view factor, the cosine-weighted open fraction of the hemisphere.
    """

    position_world: Float[np.ndarray, "n 3"]
    normal_world: Float[np.ndarray, "n 3"]
    log_radiance: Float[np.ndarray, " n"]
    material: Int64[np.ndarray, " n"]
    sky_view_factor: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.log_radiance)


def sample_surfaces(
    mesh: TriMesh,
    casters: Sequence[TriMesh],
    path_world: Float[np.ndarray, "p 3"],
    make_caster: MakeCaster,
    config: SampleConfig,
    rng: np.random.Generator,
) -> tuple[SurfaceSamples, RayCaster]:
    """Return points of a mesh with observed radiance, and a ray caster of all surfaces that cast
    shadows.

    Args:
        mesh: static surfaces, frame `world`; `base_colour` is radiance.
        casters: further surfaces that cast shadows.
        path_world: positions of the cameras.
    """
    caster = make_caster([mesh, *casters])
    face, barycentric = _drawn_faces(mesh, path_world, config, rng)
    corners = mesh.vertices[mesh.faces[face]].astype(np.float64)
    position = (corners * barycentric[:, :, None]).sum(axis=1)
    normal = mesh.face_normals()[face]
    # Normals are turned towards the path: only that side of a thin wall was observed.
    nearest = path_world[KDTree(path_world).query(position)[1]]
    is_away = np.einsum("ij,ij->i", normal, nearest - position) < 0
    normal = np.where(is_away[:, None], -normal, normal)
    radiance = luminance(mesh.colour_at(face, barycentric)).astype(np.float64)
    keep = (radiance > 1e-3) & (np.linalg.norm(normal, axis=1) > 0.5)
    if mesh.confidence is not None:
        confidence = (mesh.confidence[mesh.faces[face]] * barycentric).sum(axis=1)
        keep &= confidence >= _MIN_CONFIDENCE
    material = np.zeros(len(face), np.int64)
    if mesh.face_material is not None:
        material = mesh.face_material[face].astype(np.int64)
    keep &= ~mesh.has_provenance(*_UNMEASURED)[face]
    position, normal, radiance, material = (a[keep] for a in (position, normal, radiance, material))
    sky_view_factor = _sky_view_factor(
        caster, position + RAY_OFFSET_M * normal, normal, config, rng
    )
    return SurfaceSamples(position, normal, np.log(radiance), material, sky_view_factor), caster


def _drawn_faces(
    mesh: TriMesh,
    path_world: Float[np.ndarray, "p 3"],
    config: SampleConfig,
    rng: np.random.Generator,
) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Draw area-weighted faces near the path and uniform points on them, twice the requested number
    because some are rejected later."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    distance_m = KDTree(path_world).query(corners.mean(axis=1))[0]
    weight = np.where(distance_m < _REACH_M, area, 0.0)
    if not weight.sum() > 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    face = rng.choice(len(weight), 2 * config.point_count, p=weight / weight.sum())
    u, v = np.sqrt(rng.random(len(face))), rng.random(len(face))
    return face.astype(np.int64), np.stack([1 - u, u * (1 - v), u * v], axis=1)


def _sky_view_factor(
    caster: RayCaster,
    start: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    config: SampleConfig,
    rng: np.random.Generator,
) -> Float[np.ndarray, " n"]:
    """Sky view factor of each point by cosine-weighted rays."""
    found = np.zeros(len(start))
    for _ in range(config.sky_rays):
        sphere = rng.normal(size=normal.shape)
        sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        # A point on the unit sphere around the normal's tip is cosine-distributed.
        direction = normal + (1 - 1e-6) * sphere
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        found += (direction[:, 2] > 0) & ~caster.is_occluded(start, direction)
    return found / config.sky_rays
