"""Fields to meshes without colour: the static scene and every actor."""

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
"""Takes the noise off a level of the background that lies on known shapes, such as walls; the
number is the distance between the level's samples, in metres."""


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test).

# Grid samples with less evidence than this count as unknown.
_MIN_WEIGHT = 0.03
# Connected pieces of the background smaller than this are dropped.
_MIN_PIECE_M2 = 0.25
# Filtering moves no vertex further than this many samples of its level.
_MAX_MOVE_VOXELS = 0.2
# Simplification may deviate by this many samples of a level (RMS).
_ERROR_VOXELS = 0.1
# Simplification makes no edge longer than this many samples of a level.
_EDGE_VOXELS = 6.0
# The same along the outlines of panes and tyres.
_PANE_EDGE_VOXELS = 1.5
_PANE, _TYRE = 1, 2


def mesh_scene(
    log: DrivingLog,
    fields: SceneFields,
    *,
    make_caster: MakeCaster,
    progress: Progress,
    smooth_planes: SmoothPlanes | None = None,
) -> SceneAssets:
    """Background and actors as black meshes; no gains yet (assets.build.build_assets)."""
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
    """An actor's surface; faces know their provenance and material: paint, panes and tyres."""
    surface, evidence = actor_surface(track, grid, returns)
    paint, body, voxel_m = material_of_actor(track.kind), evidence.body, evidence.voxel_m
    if body is None:
        mesh = _refined(surface, voxel_m)
        provenance = evidence.provenance(_centres(mesh), np.zeros(len(mesh.faces), dtype=bool))
        return replace(mesh, face_provenance=provenance, materials=(paint,))
    # Short edges keep the outline of the panes.
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
    """0 for paint, `_PANE` or `_TYRE`, face by face."""
    centres = _centres(mesh)
    is_tyre, is_pane = body.is_tyre(centres), body.is_pane(centres, mesh.face_normals())
    return np.select([is_tyre, is_pane], [_TYRE, _PANE], 0).astype(np.uint8)


def _is_between_parts(mesh: TriMesh, part: UInt8[np.ndarray, " m"]) -> Bool[np.ndarray, " n"]:
    """Vertices whose faces belong to different parts."""
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
    """All levels of the static scene in one mesh, ground closed; black."""
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
    """Of a field whose zero level is empty."""
    return InputError(
        "the reconstructed field has no surface",
        remedy="Train longer (--neural-steps), or start from fused LiDAR (--preset standard).",
    )


def _refined(mesh: TriMesh, voxel_m: float) -> TriMesh:
    """Without noise of marching cubes, and with no more faces than the shape needs."""
    return simplified(denoise(mesh, _MAX_MOVE_VOXELS * voxel_m), voxel_m)


def simplified(mesh: TriMesh, voxel_m: float) -> TriMesh:
    """With no more faces than the shape needs that samples of this distance have given."""
    count = len(mesh.vertices)
    return simplify(
        mesh,
        np.full(count, _ERROR_VOXELS * voxel_m),
        np.full(count, _EDGE_VOXELS * voxel_m),
    )
