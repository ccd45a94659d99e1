"""Evaluation of the trained field at the samples of sparse grids, for meshing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32

from lightsim.core.colour import linear_from_srgb
from lightsim.core.fields import BLOCK, SceneFields, TsdfGrid
from lightsim.core.mesh import TriMesh
from lightsim.networks.devices import device_of
from lightsim.progress import Progress
from lightsim.reconstruct.field.sdf_field import SceneField

# Points evaluated together, to limit memory.
_BATCH = 131_072


def refined_fields(fields: SceneFields, field: SceneField, *, progress: Progress) -> SceneFields:
    """Replace the signed distances of all observed samples by those of the field.

    Unobserved samples stay unknown, so that the field adds no surface without observation.
    """
    numbers = {actor_id: number for number, actor_id in enumerate(field.actor_ids)}
    levels = tuple(
        _refined(grid, field, -1)
        for grid in progress.track(fields.background, "evaluate the background")
    )
    actors = {
        actor_id: _refined(grid, field, numbers[actor_id])
        for actor_id, grid in progress.track(
            fields.actors.items(), "evaluate the actors", len(fields.actors)
        )
    }
    return replace(fields, background=levels, actors=actors)


def _refined(grid: TsdfGrid, field: SceneField, actor: int) -> TsdfGrid:
    """Evaluate the field at one grid's samples; distances are clipped to its truncation."""
    block, *local = np.nonzero(grid.weight > 0)
    if len(block) == 0:
        return grid
    steps = BLOCK * grid.block_coords[block].astype(np.float64) + np.stack(local, axis=1)
    points = (grid.origin_m + grid.voxel_m * steps).astype(np.float32)
    sdf = grid.sdf_m.copy()
    found = signed_distances(field, points, actor)
    sdf[(block, *local)] = np.clip(found, -grid.truncation_m, grid.truncation_m)
    return replace(grid, sdf_m=sdf)


def signed_distances(
    field: SceneField, points: Float32[np.ndarray, "n 3"], actor: int
) -> Float32[np.ndarray, " n"]:
    """Return the signed distance of points in the frame of the background (-1) or of an actor."""
    parts = [sdf for sdf, _ in _evaluated(field, points, actor)]
    return np.concatenate([np.zeros(0, np.float32), *parts])


def vertex_radiance(field: SceneField, mesh: TriMesh, actor: int) -> Float32[np.ndarray, "n 3"]:
    """Return the field's colour k_d at each vertex as linear radiance, without camera gains.

    It is the paper's base colour (appendix, "Neural Scene Reconstruction").
    """
    parts = [colour for _, colour in _evaluated(field, mesh.vertices, actor)]
    colours = np.concatenate([np.zeros((0, 3), np.float32), *parts])
    return linear_from_srgb(colours).astype(np.float32)


def _evaluated(
    field: SceneField, points: Float32[np.ndarray, "n 3"], actor: int
) -> Iterator[tuple[Float32[np.ndarray, " b"], Float32[np.ndarray, "b 3"]]]:
    """Yield signed distances and sRGB colours of batches of points."""
    device = device_of(field)
    for start in range(0, len(points), _BATCH):
        part = torch.from_numpy(points[start : start + _BATCH]).to(device)
        owner = torch.full((len(part),), actor, dtype=torch.int64, device=device)
        with torch.no_grad():
            sdf, colour, _, _ = field(part, owner)
        yield sdf.cpu().numpy(), colour.cpu().numpy()
