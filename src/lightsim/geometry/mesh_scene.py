"""Meshes without colour of the static scene and of every actor, from signed-distance fields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from lightsim.core.actors import ActorTrack
from lightsim.core.casting import MakeCaster
from lightsim.core.fields import SceneFields, TsdfGrid
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.notes import grouped_notes
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.errors import InputError
from lightsim.geometry.actors.body import Body
from lightsim.geometry.actors.returns import returns_of_actors
from lightsim.geometry.actors.shape import actor_surface
from lightsim.geometry.completion.ground import ground_patches, trim_ground
from lightsim.geometry.materials import GLASS, TYRE, classify_background, material_of_actor
from lightsim.geometry.simplify import denoise, simplify
from lightsim.geometry.surface import background_levels, drop_floaters
from lightsim.progress import Progress

SmoothPlanes = Callable[[TriMesh, float], TriMesh]
"""Function that removes noise of a background level on known shapes, such as walls.

Arguments: the mesh, and the distance between the level's samples in metres.
"""

# Chosen on log 002 and synthetic street 0; only the combination is measured
# (docs/benchmarks/reconstruction.md, with street 1 as the test).

# Weight below which a grid sample is unknown.
_MIN_WEIGHT = 0.03
# Area below which a connected piece of the background is dropped as noise.
_MIN_PIECE_M2 = 0.25
# Largest motion of a vertex by denoising, in samples of its level.
_MAX_MOVE_VOXELS = 0.2
# Largest RMS error of the simplification, in samples of a level.
_ERROR_VOXELS = 0.1
# Longest edge of the simplified mesh, in samples of a level.
_EDGE_VOXELS = 6.0
# Longest edge along the outlines of panes and tyres, in samples; longer ones would blur them.
_PANE_EDGE_VOXELS = 1.5
# Index of glass among the materials of a vehicle; 0 is paint.
_PANE = 1
# Index of rubber among the materials of a vehicle.
_TYRE = 2


def mesh_scene(
    log: DrivingLog,
    fields: SceneFields,
    *,
    make_caster: MakeCaster,
    progress: Progress,
    smooth_planes: SmoothPlanes,
) -> SceneAssets:
    """Mesh the background and the actors in black; `assets.build` adds colours and gains."""
    background = mesh_background(fields, make_caster, smooth_planes)
    background = classify_background(background, log, fields.ground)
    actors: dict[str, ActorAsset] = {}
    defaults: list[str] = []
    returns = returns_of_actors(log)
    for track in progress.track(log.actors, "mesh the actors", len(log.actors)):
        grid = fields.actors.get(track.actor_id)
        mesh = _actor_mesh(track, grid, returns.get(track.actor_id))
        actors[track.actor_id] = ActorAsset(track.actor_id, track.kind, mesh, track.label)
        if grid is None:
            defaults.append(f"{track.actor_id} ({track.label})")
    notes = grouped_notes({"default shape, too few returns": defaults}, "actor")
    return SceneAssets(background, actors, {}, (*fields.notes, *notes))


def _actor_mesh(
    track: ActorTrack, grid: TsdfGrid | None, returns: Float32[np.ndarray, "n 3"] | None
) -> TriMesh:
    """Return an actor's surface with provenance and, for vehicles, paint, panes and tyres."""
    surface, evidence = actor_surface(track, grid, returns)
    paint, body, voxel_m = material_of_actor(track.kind), evidence.body, evidence.voxel_m
    if body is None:
        mesh = _refined(surface, voxel_m)
        provenance = evidence.provenance(_centres(mesh), np.zeros(len(mesh.faces), dtype=bool))
        return replace(mesh, face_provenance=provenance, materials=(paint,))
    # Short edges preserve the outlines of panes and tyres.
    edges = np.full(len(surface.vertices), _EDGE_VOXELS * voxel_m)
    edges[_is_between_parts(surface, _part(surface, body))] = _PANE_EDGE_VOXELS * voxel_m
    mesh = simplify(surface, np.full(len(edges), _ERROR_VOXELS * voxel_m), edges)
    part = _part(mesh, body)
    return replace(
        mesh,
        face_provenance=evidence.provenance(_centres(mesh), part == _PANE),
        materials=(paint, GLASS, TYRE),
        face_material=part,
    )


def _part(mesh: TriMesh, body: Body) -> UInt8[np.ndarray, " m"]:
    """Return the part of each face: 0 for paint, `_PANE` or `_TYRE`."""
    centres = _centres(mesh)
    is_tyre, is_pane = body.is_tyre(centres), body.is_pane(centres, mesh.face_normals())
    return np.select([is_tyre, is_pane], [_TYRE, _PANE], 0).astype(np.uint8)


def _is_between_parts(mesh: TriMesh, part: UInt8[np.ndarray, " m"]) -> Bool[np.ndarray, " n"]:
    """Return True for vertices whose faces belong to different parts."""
    low = np.full(len(mesh.vertices), 255, dtype=np.uint8)
    high = np.zeros(len(mesh.vertices), dtype=np.uint8)
    for corner in mesh.faces.T:
        np.minimum.at(low, corner, part)
        np.maximum.at(high, corner, part)
    return low != high


def _centres(mesh: TriMesh) -> Float64[np.ndarray, "m 3"]:
    return mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)


def mesh_background(
    fields: SceneFields, make_caster: MakeCaster, smooth_planes: SmoothPlanes | None = None
) -> TriMesh:
    """Return all levels of the static scene in one black mesh, with holes of the ground closed.

    Raises:
        InputError: the field has no surface.
    """
    levels = []
    for level, grid in zip(background_levels(fields, _MIN_WEIGHT), fields.background, strict=True):
        mesh = drop_floaters(level, _MIN_PIECE_M2)
        mesh = trim_ground(mesh, fields.ground, fields.path_m)
        if smooth_planes is not None:
            mesh = smooth_planes(mesh, grid.voxel_m)
        levels.append(_refined(mesh, grid.voxel_m))
    surface = concatenate_meshes(levels)
    if len(surface.faces) == 0:
        raise no_surface()
    reach_m = fields.background_radius_m[-1]
    patches = ground_patches(surface, fields.ground, fields.path_m, reach_m, make_caster)
    return concatenate_meshes([surface, patches])


def no_surface() -> InputError:
    """Return the error of a background field whose zero level set is empty."""
    return InputError(
        "the reconstructed background has no surface",
        remedy="Train longer (--neural-steps), or start from fused LiDAR (--preset standard).",
    )


def _refined(mesh: TriMesh, voxel_m: float) -> TriMesh:
    """Return the mesh without the noise of marching cubes and with fewer faces."""
    return simplified(denoise(mesh, _MAX_MOVE_VOXELS * voxel_m), voxel_m)


def simplified(mesh: TriMesh, voxel_m: float) -> TriMesh:
    """Return the mesh with fewer faces, with error bounds proportional to the sample distance."""
    count = len(mesh.vertices)
    return simplify(
        mesh,
        np.full(count, _ERROR_VOXELS * voxel_m),
        np.full(count, _EDGE_VOXELS * voxel_m),
    )
