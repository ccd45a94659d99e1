"""Meshes of the paper: the field's zero level, decimated, and nothing else (Sec. 3.1, A.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightsim.core.fields import SceneFields
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import Material, Provenance, TriMesh, concatenate_meshes
from lightsim.core.notes import grouped_notes
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.geometry.mesh_scene import no_surface, simplified
from lightsim.geometry.surface import background_levels, extract_surface
from lightsim.progress import Progress

_BACKGROUND, _ACTOR = Material(0.8, 0.0, "background"), Material(0.5, 0.0, "actor")


@dataclass(frozen=True)
class BaseMaterials:
    """One material for all that stands still and one for all actors (appendix: "we set materials
    for dynamic assets and background separately"). The paper gives no values."""

    background: Material = _BACKGROUND
    """As rough as our own matte class."""
    actor: Material = _ACTOR
    """Blender's Principled BSDF as it starts."""


def mesh_plainly(
    log: DrivingLog, fields: SceneFields, materials: BaseMaterials, *, progress: Progress
) -> SceneAssets:
    """Background and actors as black meshes by marching cubes and quadric decimation. Nothing is
    smoothed, closed, classified or guessed; actors without a surface in the field are missing.

    Raises:
        InputError: the background has no surface.
    """
    levels = [
        simplified(level, grid.voxel_m)
        for level, grid in zip(background_levels(fields, 0.0), fields.background, strict=True)
    ]
    background = _of(concatenate_meshes(levels), materials.background)
    if len(background.faces) == 0:
        raise no_surface()
    actors: dict[str, ActorAsset] = {}
    empty: list[str] = []
    for track in progress.track(log.actors, "mesh the actors", len(log.actors)):
        grid = fields.actors[track.actor_id]
        mesh = _of(simplified(extract_surface(grid), grid.voxel_m), materials.actor)
        if len(mesh.faces) == 0:
            empty.append(f"{track.actor_id} ({track.label})")
            continue
        actors[track.actor_id] = ActorAsset(track.actor_id, track.kind, mesh, track.label)
    notes = grouped_notes({"the field has no surface": empty}, "actor")
    return SceneAssets(background, actors, {}, (*fields.notes, *notes))


def _of(mesh: TriMesh, material: Material) -> TriMesh:
    """The mesh of one material, all of it measured."""
    black = np.zeros_like(mesh.vertices)
    plain = TriMesh(mesh.frame, mesh.vertices, mesh.faces, black, (material,))
    return plain.with_provenance(Provenance.MEASURED)
