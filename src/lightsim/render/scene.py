"""Scene to render: the static part, built once per log, and the actors at one time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int32

from lightsim.core.buffers import BACKGROUND
from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.dome import Sun
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.composite import CompositeCaster
from lightsim.render.roofs import UncertainRoofs


@dataclass(frozen=True, eq=False)
class StaticScene:
    """Static part of the scene; made by `make_static_scene`.

    Args:
        background: reconstructed meshes, in frame `world`.
        inferred: meshes of unobserved surfaces; they block light and reflect it.
        background_caster: over `background`.
        caster: over `background`, then `inferred`: the surfaces that light meets.
        normals: vertex normals of `background`, then of `inferred`.
        roofs: uncertain shapes of `inferred`, for suns whose shadows no image shows.
        inferred_is_visible: cameras show `inferred` too.
    """

    background: tuple[TriMesh, ...]
    inferred: tuple[TriMesh, ...]
    background_caster: RayCaster
    caster: RayCaster
    normals: tuple[Float32[np.ndarray, "_ 3"], ...]
    roofs: UncertainRoofs | None = None
    inferred_is_visible: bool = False

    @property
    def meshes(self) -> tuple[TriMesh, ...]:
        """Background, then inferred meshes, in the order of `caster`."""
        return self.background + self.inferred

    @property
    def camera_meshes(self) -> tuple[TriMesh, ...]:
        """Meshes that are visible to cameras."""
        return self.meshes if self.inferred_is_visible else self.background

    @property
    def camera_caster(self) -> RayCaster:
        """Ray caster over `camera_meshes`."""
        return self.caster if self.inferred_is_visible else self.background_caster


@dataclass(frozen=True, eq=False)
class FrameScene:
    """Scene at one time.

    Args:
        static: the part common to all frames.
        actors: meshes of the placed actors in frame `world`, in the order of
            `Scenario.placements_at`.
        actor_caster: over `actors`.
        actor_normals: vertex normals of `actors`.
        actor_numbers: numbers of `actors` in the scenario.
        vacated: parked actors of the log that are not in the scenario; their shadows are part of
            the sun visibility that was estimated from images.
    """

    static: StaticScene
    actors: tuple[TriMesh, ...]
    actor_caster: RayCaster
    actor_normals: tuple[Float32[np.ndarray, "_ 3"], ...]
    actor_numbers: tuple[int, ...]
    vacated: tuple[TriMesh, ...] = ()

    @property
    def meshes(self) -> tuple[TriMesh, ...]:
        """Static meshes (background, then inferred), then actors."""
        return self.static.meshes + self.actors

    @property
    def caster(self) -> CompositeCaster:
        """Ray caster over all surfaces that light meets; `mesh_index` counts `meshes`."""
        return CompositeCaster([self.static.caster, self.actor_caster])

    def certain_sun_occluders(self, sun: Sun) -> tuple[RayCaster, UncertainRoofs | None]:
        """Return a caster over the certain occluders of a sun, and the roofs if they are uncertain
        for it."""
        roofs = self.static.roofs
        if roofs is None or roofs.are_observed(sun):
            return self.caster, None
        # Without `inferred`, which is only one of the possible shapes of the roofs.
        return CompositeCaster([self.static.background_caster, self.actor_caster]), roofs

    @property
    def camera_caster(self) -> CompositeCaster:
        """Ray caster over the surfaces visible to cameras; `mesh_index` counts `camera_meshes`."""
        return CompositeCaster([self.static.camera_caster, self.actor_caster])

    @property
    def camera_meshes(self) -> tuple[TriMesh, ...]:
        """Static meshes visible to cameras, then actors."""
        return self.static.camera_meshes + self.actors

    @property
    def camera_normals(self) -> tuple[Float32[np.ndarray, "_ 3"], ...]:
        """Vertex normals of `camera_meshes`."""
        # Normals of `inferred` come last, so the slice leaves them out if cameras do not show them.
        return self.static.normals[: len(self.static.camera_meshes)] + self.actor_normals

    @property
    def actor_index(self) -> Int32[np.ndarray, " m"]:
        """BACKGROUND, or the actor's number in the scenario, of each of `camera_meshes`."""
        background = np.full(len(self.static.camera_meshes), BACKGROUND, dtype=np.int32)
        return np.concatenate([background, np.array(self.actor_numbers, dtype=np.int32)])


def make_static_scene(
    background: Sequence[TriMesh],
    inferred: Sequence[TriMesh] = (),
    *,
    inferred_is_visible: bool = False,
    make_caster: MakeCaster = make_embree_caster,
) -> StaticScene:
    """Return static meshes with their ray casting structures.

    Args:
        background: reconstructed meshes in frame `world`.
        inferred: meshes of unobserved surfaces (roofs, upper facades), inferred from their shadows.
        inferred_is_visible: cameras show the inferred meshes too, so that pixels beyond the reach
            of the LiDAR have a surface.
    """
    background, inferred = tuple(background), tuple(inferred)
    background_caster = make_caster(background)
    return StaticScene(
        background,
        inferred,
        background_caster,
        # A second structure over the same meshes costs memory, so it is built only if it differs.
        make_caster(background + inferred) if inferred else background_caster,
        tuple(mesh.vertex_normals() for mesh in background + inferred),
        inferred_is_visible=inferred_is_visible,
    )


def place(
    static: StaticScene,
    scenario: Scenario,
    time_ns: int,
    make_caster: MakeCaster = make_embree_caster,
) -> FrameScene:
    """Return the static scene with the scenario's actors at their poses at `time_ns`."""
    placements = scenario.placements_at(time_ns)
    actors = placed_meshes(placements, time_ns)
    # Parked actors are those with an estimated sun visibility on their own mesh.
    left = [p for p in scenario.vacated if p.track.is_present(time_ns)]
    return FrameScene(
        static,
        actors,
        make_caster(actors),
        tuple(mesh.vertex_normals() for mesh in actors),
        tuple(scenario.number_by_actor[p.track.actor_id] for p in placements),
        tuple(m for m in placed_meshes(left, time_ns) if m.sun_visibility is not None),
    )


def placed_meshes(placements: Sequence[ActorPlacement], time_ns: int) -> tuple[TriMesh, ...]:
    """Return the meshes of actors in frame `world` at a time."""
    return tuple(p.mesh_at(time_ns) for p in placements)


def with_dilated_copies(meshes: Sequence[TriMesh], by_m: float) -> list[TriMesh]:
    """Return the meshes, followed by copies whose surfaces are moved outwards by some metres.

    Together they bound the shadows of objects of about these shapes; the offset copies alone have
    gaps at sharp edges.
    """
    moved = [
        replace(m, vertices=m.vertices + np.float32(by_m) * m.vertex_normals()) for m in meshes
    ]
    return [*meshes, *moved]


def without_actors(static: StaticScene) -> FrameScene:
    """Return the static scene without actors."""
    return FrameScene(static, (), make_embree_caster(()), (), ())
