"""Ray queries in the street at one time, for LiDAR and exact buffers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from lightsim.core.buffers import BACKGROUND
from lightsim.core.frames import RigidTransform
from lightsim_lab.synthetic.shapes import Part, joined
from lightsim_lab.synthetic.street import Street
from lightsim_lab.synthetic.textures import Finish

# Offset of ray origins from the surface along its normal, in metres, against self-intersection.
_OFFSET_M = 2e-3


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of rays. Misses have distance inf, face -1, and normal 0."""

    distance_m: Float[np.ndarray, " n"]
    face: Int32[np.ndarray, " n"]
    normal_world: Float[np.ndarray, "n 3"]
    uv_m: Float[np.ndarray, "n 2"]

    @property
    def is_hit(self) -> Bool[np.ndarray, " n"]:
        """True for rays that hit a triangle."""
        return self.face >= 0


class Snapshot:
    """Triangles of a street in frame `world`, with actors at given poses.

    The ego vehicle's body is present if its pose `world_from_ego` is given; its index in `actor` is
    the number of actors.
    """

    def __init__(
        self,
        street: Street,
        world_from_actors: Sequence[RigidTransform],
        world_from_ego: RigidTransform | None = None,
    ) -> None:
        world_from_street = street.plan.world_from_street
        placed: list[tuple[int, Part]] = [
            (BACKGROUND, part.transformed(world_from_street)) for part in street.background
        ]
        for i, (actor, pose) in enumerate(zip(street.participants, world_from_actors, strict=True)):
            placed += [(i, part.transformed(pose)) for part in actor.parts]
        if world_from_ego is not None:
            number = len(street.participants)
            placed += [(number, part.transformed(world_from_ego)) for part in street.ego_body]
        self.names = tuple(street.finishes)
        self.finishes: Mapping[str, Finish] = street.finishes
        self.vertices, self.faces = joined([part for _, part in placed])
        self.uv_m = np.concatenate([part.uv_m for _, part in placed])
        counts = [len(part.faces) for _, part in placed]
        self.actor = np.repeat([i for i, _ in placed], counts).astype(np.int32)
        self.material = np.repeat([self.names.index(p.material) for _, p in placed], counts)
        self._scene = _embree(self.vertices, self.faces)

    def intersect(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> Hits:
        """Return the first hits along unit directions."""
        found = self._scene.run(
            origins_world.astype(np.float32),
            directions_world.astype(np.float32),
            query="INTERSECT",
            output=True,
        )
        face = found["primID"].astype(np.int32)
        is_hit = face >= 0
        distance = np.where(is_hit, found["tfar"], np.inf).astype(np.float64)
        safe = np.where(is_hit, face, 0)
        a, b, c = (self.vertices[self.faces[safe, k]].astype(np.float64) for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        # Faces are two-sided: normals point to the origin of the ray.
        is_away = (normal * directions_world).sum(axis=1) > 0
        normal[is_away] *= -1
        normal[~is_hit] = 0.0
        u, v = found["u"].astype(np.float64)[:, None], found["v"].astype(np.float64)[:, None]
        uv = [self.uv_m[self.faces[safe, k]].astype(np.float64) for k in range(3)]
        return Hits(distance, face, normal, (1 - u - v) * uv[0] + u * uv[1] + v * uv[2])

    def base_colour(self, hits: Hits) -> Float[np.ndarray, "n 3"]:
        """Return the linear base colour at the hits; 0 for misses."""
        colour = np.zeros((len(hits.face), 3))
        material = np.where(hits.is_hit, self.material[hits.face], -1)
        for index in np.unique(material[material >= 0]).tolist():
            chosen = material == index
            colour[chosen] = self.finishes[self.names[index]].look_up(hits.uv_m[chosen])
        return colour

    def lidar_gain(self, hits: Hits) -> Float[np.ndarray, " n"]:
        """Return the factor of each hit's material on the LiDAR return; undefined for misses."""
        gains = np.array([self.finishes[name].lidar_gain for name in self.names])
        return gains[self.material[hits.face]]

    def is_occluded(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Return True for rays that hit any triangle, at any distance."""
        found = self._scene.run(
            origins_world.astype(np.float32), directions_world.astype(np.float32), query="INTERSECT"
        )
        return np.asarray(found) >= 0

    def sun_visibility(
        self,
        points_world: Float[np.ndarray, "n 3"],
        normals_world: Float[np.ndarray, "n 3"],
        disc_world: Float[np.ndarray, "k 3"],
    ) -> Float[np.ndarray, " n"]:
        """Return the fraction of the sun's disc that is visible at each point.

        Args:
            disc_world: directions towards points of the disc.
        """
        origins = points_world + _OFFSET_M * normals_world
        visible = np.zeros(len(origins))
        for direction in disc_world:
            faces_sun = normals_world @ direction > 0
            towards = np.broadcast_to(direction, origins.shape)
            visible[faces_sun] += ~self.is_occluded(origins[faces_sun], towards[faces_sun])
        return visible / len(disc_world)


def _embree(vertices: Float32[np.ndarray, "n 3"], faces: Int32[np.ndarray, "m 3"]) -> Any:
    # Imported here, as Embree is needed for rays alone.
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices, faces)
    return scene
