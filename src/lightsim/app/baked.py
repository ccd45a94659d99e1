"""Meshes with the light of one sky at one frame, for the page without a server.

The client of viser casts shadows within about 20 m of its camera only, and its sky light passes
through surfaces. A page, whose light does not change, shows ray-traced irradiance at the vertices
instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from lightsim.app.glb import main_axis, mesh_glb
from lightsim.app.meshes import ViewMeshes
from lightsim.core.dome import SkyDome
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import Scenario
from lightsim.progress import Progress
from lightsim.render.scene import FrameScene, make_static_scene, place
from lightsim.render.transport.faces import TransportConfig
from lightsim.render.transport.irradiance import IrradianceConfig, irradiance_at
from lightsim.render.transport.lobes import Lobes

# Rays to the sky for each point: noise of some percent, which interpolation over faces hides.
# Chosen; sensitivity not measured.
_RAYS = IrradianceConfig(TransportConfig(sky_rays=16))
# Distance from a vertex to the point that represents it, as a fraction of that to the centres of
# its faces: a vertex at the foot of a wall is neither in the wall nor on both of its sides. Chosen.
_INSET = 0.25
# Distance of the points from the surface, metres: above the roughness of reconstructed surfaces.
_LIFT_M = 0.02


@dataclass(frozen=True, eq=False)
class _Points:
    """Points that represent the vertices of a mesh, several for a vertex at a crease.

    Args:
        position: metres.
        normal: unit vectors.
        base_colour: linear.
        corner: index of the point for each face's three corners.
    """

    position: Float64[np.ndarray, "n 3"]
    normal: Float64[np.ndarray, "n 3"]
    base_colour: Float32[np.ndarray, "n 3"]
    corner: Int64[np.ndarray, "m 3"]


def lit_meshes(
    background: TriMesh,
    inferred: TriMesh,
    scenario: Scenario,
    time_ns: int,
    dome: SkyDome,
    progress: Progress,
) -> ViewMeshes:
    """Return the static meshes and the actors that are present at a time, with their light.

    It is that of the sun and of the open sky. From the directions of other surfaces comes the
    mean radiance that these reflect.

    Args:
        inferred: unobserved surfaces; may have no face.
    """
    static = [mesh for mesh in (background, inferred) if len(mesh.faces)]
    scene = place(make_static_scene(static), scenario, time_ns)
    placements = scenario.placements_at(time_ns)
    meshes = [*static, *scene.actors]
    light = _light_on(meshes, scene, dome)
    # The light is that in frame `world`, on the faces of the actor's own mesh.
    shown = [*static, *(placement.asset.mesh for placement in placements)]
    pairs = list(zip(shown, light, strict=True))
    glbs = [mesh_glb(mesh, lit) for mesh, lit in progress.track(pairs, "lit meshes")]
    actors = zip(placements, glbs[len(static) :], strict=True)
    return ViewMeshes(
        glbs[0],
        glbs[1] if len(static) > 1 else None,
        {placement.track.actor_id: glb for placement, glb in actors},
    )


def _light_on(
    meshes: Sequence[TriMesh], scene: FrameScene, dome: SkyDome
) -> list[Float32[np.ndarray, "m 3 3"]]:
    """Return irradiance / pi at the corners of the faces of each mesh, RGB."""
    points = [_points_of(mesh) for mesh in meshes]
    surface = Lobes.none_on(
        np.concatenate([p.position for p in points]), np.concatenate([p.normal for p in points])
    )
    found = irradiance_at(surface, scene, dome, _RAYS)
    direct = found.sun + found.sky
    base_colour = np.concatenate([p.base_colour for p in points])
    reflected = (base_colour * direct).mean(axis=0)
    light = direct + (1.0 - found.sky_visibility[:, None]) * reflected
    ends = np.cumsum([len(p.position) for p in points])[:-1]
    parts = np.split(light.astype(np.float32), ends)
    return [part[p.corner] for p, part in zip(points, parts, strict=True)]


def _points_of(mesh: TriMesh) -> _Points:
    """Return one point for each vertex and main axis of its faces."""
    axis = main_axis(mesh, np.arange(len(mesh.faces)))
    # Six directions: one number for each pair of vertex and direction.
    pairs = mesh.faces.astype(np.int64) * 6 + axis[:, None]
    group, corner = np.unique(pairs, return_inverse=True)
    corner = corner.reshape(-1, 3)
    number = group // 6
    place_m = mesh.vertices[number].astype(np.float64)
    colour = mesh.base_colour[number]
    split = TriMesh(mesh.frame, mesh.vertices[number], corner.astype(np.int32), colour)
    normal = split.vertex_normals().astype(np.float64)
    centres = place_m[corner].mean(axis=1)
    inward = _mean_of_faces(centres, corner, len(group)) - place_m
    # Along the surface: the centres of a curved surface's faces lie below it.
    inward -= np.einsum("nc,nc->n", inward, normal)[:, None] * normal
    return _Points(place_m + _INSET * inward + _LIFT_M * normal, normal, colour, corner)


def _mean_of_faces(
    values: Float64[np.ndarray, "m 3"], corner: Int64[np.ndarray, "m 3"], count: int
) -> Float64[np.ndarray, "n 3"]:
    """Return the mean of a value over the faces around each point."""
    number = corner.reshape(-1)
    sums = [np.bincount(number, np.repeat(values[:, k], 3), count) for k in range(3)]
    return np.stack(sums, axis=1) / np.bincount(number, minlength=count)[:, None]
