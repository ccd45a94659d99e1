"""Points of the reconstructed surfaces and the radiance that cameras saw on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import KDTree

from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.colour import luminance
from lightsim.core.mesh import Provenance, TriMesh

_MUTE = (Provenance.INFERRED, Provenance.BACKGROUND_PROXY)
"""Surfaces whose shape was guessed: they cast shadows but have no say."""

# Chosen with streets 0 and 1 and log 002 in view; only what all do together is measured
# (docs/benchmarks/lighting.md).

# Normals of two points of one surface differ by no more (14 degrees).
SAME_PLANE_COSINE = 0.97
# The second lies this close to the first one's plane.
SAME_PLANE_OFFSET_M = 0.15
# Observations within a block of this size share their errors and count as one.
BLOCK_M = 4.0
# Rays start this far above a surface, so that they miss the bumps of its mesh.
LIFT_M = 0.08
# Points lie this close to the path of the cameras.
_REACH_M = 35.0
# Surfaces whose colour was guessed do not count.
_MIN_CONFIDENCE = 0.5


@dataclass(frozen=True)
class SampleConfig:
    """Which surface points are asked."""

    point_count: int = 4000
    """Surface points, about, in proportion to area."""
    sky_rays: int = 32
    """Cosine-weighted rays that measure how much sky a point sees."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points of surfaces in frame `world`.

    Args:
        log_radiance: natural logarithm of the observed luminance.
        material: class of the surface.
        sky_fraction: cosine-weighted open fraction of the hemisphere that is sky.
    """

    position_world: Float[np.ndarray, "n 3"]
    normal_world: Float[np.ndarray, "n 3"]
    log_radiance: Float[np.ndarray, " n"]
    material: Int64[np.ndarray, " n"]
    sky_fraction: Float[np.ndarray, " n"]

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
    """Points of a mesh that shows observed radiance, and the caster of all that may shade them.

    Args:
        mesh: static surfaces, frame `world`; `base_colour` is radiance.
        casters: further surfaces that cast shadows.
        path_world: where cameras stood.
    """
    caster = make_caster([mesh, *casters])
    face, barycentric = _drawn_faces(mesh, path_world, config, rng)
    corners = mesh.vertices[mesh.faces[face]].astype(np.float64)
    position = (corners * barycentric[:, :, None]).sum(axis=1)
    normal = mesh.face_normals()[face]
    # Seen from the path: thin walls have two sides, and only one was seen.
    nearest = path_world[KDTree(path_world).query(position)[1]]
    is_away = np.einsum("ij,ij->i", normal, nearest - position) < 0
    normal = np.where(is_away[:, None], -normal, normal)
    radiance = luminance(mesh.colour_at(face, barycentric)).astype(np.float64)
    keep = (radiance > 1e-3) & (np.linalg.norm(normal, axis=1) > 0.5)
    if mesh.confidence is not None:
        trust = (mesh.confidence[mesh.faces[face]] * barycentric).sum(axis=1)
        keep &= trust >= _MIN_CONFIDENCE
    material = np.zeros(len(face), np.int64)
    if mesh.face_material is not None:
        material = mesh.face_material[face].astype(np.int64)
    keep &= ~mesh.comes_from(*_MUTE)[face]
    position, normal, radiance, material = (a[keep] for a in (position, normal, radiance, material))
    sky_fraction = _sky_fraction(caster, position + LIFT_M * normal, normal, config, rng)
    return SurfaceSamples(position, normal, np.log(radiance), material, sky_fraction), caster


def _drawn_faces(
    mesh: TriMesh,
    path_world: Float[np.ndarray, "p 3"],
    config: SampleConfig,
    rng: np.random.Generator,
) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Area-weighted faces near the path and uniform points in them; more than asked for, because
    some will be dropped."""
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


def _sky_fraction(
    caster: RayCaster,
    start: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    config: SampleConfig,
    rng: np.random.Generator,
) -> Float[np.ndarray, " n"]:
    found = np.zeros(len(start))
    for _ in range(config.sky_rays):
        sphere = rng.normal(size=normal.shape)
        sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
        direction = normal + (1 - 1e-6) * sphere
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        found += (direction[:, 2] > 0) & ~caster.is_occluded(start, direction)
    return found / config.sky_rays
