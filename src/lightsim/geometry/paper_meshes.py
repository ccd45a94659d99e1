"""Meshes of the paper: the field's zero level set, decimated (Sec. 3.1, A.1)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lightsim.core.fields import SceneFields
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import Material, Provenance, TriMesh, concatenate_meshes
from lightsim.core.notes import grouped_notes
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.geometry.mesh_scene import no_surface, simplified
from lightsim.geometry.surface import background_levels, extract_surface
from lightsim.progress import Progress


@dataclass(frozen=True)
class BaseMaterials:
    """Material of the background and material of all actors (appendix: "we set materials for
    dynamic assets and background separately"). The paper gives no values."""

    background: Material = field(default=Material(0.8, 0.0, "background"))
    """Roughness of the class `geometry.materials.UNKNOWN`."""
    actor: Material = field(default=Material(0.5, 0.0, "actor"))
    """Default of Blender's Principled BSDF."""


def mesh_as_in_paper(
    log: DrivingLog, fields: SceneFields, materials: BaseMaterials, *, progress: Progress
) -> SceneAssets:
    """Mesh the background and the actors in black by marching cubes and quadric decimation.

    No surface is smoothed, closed, classified or inferred; actors whose field has no surface are
    missing.

    Raises:
        InputError: the background has no surface.
    """
    levels = [
        simplified(level, grid.voxel_m)
        for level, grid in zip(background_levels(fields, 0.0), fields.background, strict=True)
    ]
    background = _with_material(concatenate_meshes(levels), materials.background)
    if len(background.faces) == 0:
        raise no_surface()
    actors: dict[str, ActorAsset] = {}
    empty: list[str] = []
    for track in progress.track(log.actors, "mesh the actors", len(log.actors)):
        grid = fields.actors[track.actor_id]
        mesh = _with_material(simplified(extract_surface(grid), grid.voxel_m), materials.actor)
        if len(mesh.faces) == 0:
            empty.append(f"{track.actor_id} ({track.label})")
            continue
        actors[track.actor_id] = ActorAsset(track.actor_id, track.kind, mesh, track.label)
    notes = grouped_notes({"the field has no surface": empty}, "actor")
    return SceneAssets(background, actors, {}, (*fields.notes, *notes))


def _with_material(mesh: TriMesh, material: Material) -> TriMesh:
    """Return the mesh with one material and the provenance `MEASURED`."""
    black = np.zeros_like(mesh.vertices)
    plain = TriMesh(mesh.frame, mesh.vertices, mesh.faces, black, (material,))
    return plain.with_provenance(Provenance.MEASURED)
