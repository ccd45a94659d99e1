"""Structures that no LiDAR beam reached but whose shadows matter: upper facades and roofs.

A LiDAR looks up some 15 degrees. What stands above an observed facade is inferred from the
images: rays through sky pixels prove free space, rays through pixels that show something no
reconstructed surface explains vote for matter (silhouette carving, Laurentini 1994,
doi:10.1109/34.273735, seeded by facades). The result casts shadows; it is a guess and is kept
apart from measured geometry.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import MakeCaster, RayCaster, check_world
from lightsim.core.mesh import TriMesh
from lightsim.core.resample import resize_area
from lightsim.geometry.completion.extrude_columns import (
    columns_from_facades,
    find_facades,
    free_in_front_of_walls,
)
from lightsim.geometry.completion.extrude_grid import VoxelEvidence, VoxelGrid
from lightsim.geometry.completion.extrude_kernels import walk_rays
from lightsim.geometry.completion.extrude_mesh import mesh_columns
from lightsim.geometry.completion.silhouettes import (
    SKY_ALPHA,
    SOLID_ALPHA,
    View,
    check_matte,
    spaced_views,
)
from lightsim.progress import Progress

_LOWEST_RAY = -0.2
"""Vertical part of the steepest ray that is walked: below, only the road gets carved."""
_CARVED, _VOTING, _UNUSED = 0, 1, 2


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test).

# Edge of a voxel; heights are found to about one voxel.
_VOXEL_M = 0.5
# Nothing is inferred higher than this above the lowest ground.
_MAX_HEIGHT_M = 40.0
# Images vote for matter up to this distance from the camera; sky carves without limit.
_MAX_RANGE_M = 80.0
# Rays across an image.
_RAY_WIDTH_PX = 320
# Rays this close to a pixel that is not sky do not carve.
_ERODE_PX = 1
# Free space ends this far in front of a reconstructed surface.
_SURFACE_MARGIN_M = 0.75
# Views of a camera that moved less than this since its last used view are skipped.
_MIN_BASELINE_M = 0.7
# Views that must show matter in a voxel.
_MIN_VOTES = 2


def infer_tall_structures(
    background: TriMesh,
    silhouettes: Iterable[View],
    *,
    make_caster: MakeCaster,
    progress: Progress,
) -> TriMesh:
    """Shadow casters above and behind the observed facades; frame world, may be empty.

    No voxel that a confident sky ray of a used view crosses is filled, so the result never
    hides observed sky. Heights of buildings whose top no view sees end where the views end.
    A tall building behind a low one can be taken for an upper part of the low one, where
    nothing was measured between them.

    Args:
        background: measured static surfaces, frame world, outward faces counter-clockwise.
        silhouettes: frames with their camera (of the matte's size) and sky matte.
        make_caster: builds the ray caster.
        progress: reporter.

    Raises:
        FrameMismatchError: the mesh is not in frame world.
        InputError: a matte does not fit its camera.
    """
    check_world([background])
    if len(background.faces) == 0:
        return mesh_columns([], VoxelGrid(np.zeros(3), _VOXEL_M, (1, 1, 1)))
    grid = VoxelGrid.around(background, _VOXEL_M, _MAX_HEIGHT_M)
    evidence = VoxelEvidence.empty(grid)
    caster = make_caster([background])
    for view in spaced_views(progress.track(silhouettes, "silhouettes"), _MIN_BASELINE_M):
        _add_view(evidence, view, caster)
    free_in_front_of_walls(background, evidence)
    facades = find_facades(background, grid)
    columns = columns_from_facades(facades, evidence, _MIN_VOTES)
    return mesh_columns(columns, grid)


def _add_view(evidence: VoxelEvidence, view: View, caster: RayCaster) -> None:
    """Carve with the sky and with the seen surfaces of one view, vote with the unexplained."""
    frame, camera, matte = view
    small, kind = _classify_pixels(camera, matte)
    pose = frame.world_from_camera
    directions = pose.rotate(small.directions(small.pixel_centres())).reshape(-1, 3)
    origins = np.broadcast_to(pose.translation_m, directions.shape)
    hits = caster.intersect(np.ascontiguousarray(origins), directions)
    kind = kind.ravel().copy()
    # Nothing below the horizon can be sky or an upper storey, so it cannot vote.
    kind[(kind == _VOTING) & (directions[:, 2] < 0)] = _UNUSED
    is_seen = hits.is_hit & (kind != _CARVED)
    ends_m = np.where(kind == _CARVED, np.inf, _MAX_RANGE_M)
    ends_m[is_seen] = hits.distance_m[is_seen] - _SURFACE_MARGIN_M
    kind[is_seen] = _CARVED
    used = (kind != _UNUSED) & (ends_m > 0) & (directions[:, 2] > _LOWEST_RAY)
    grid = evidence.grid
    evidence.view_count += 1
    walk_rays(
        (pose.translation_m - grid.low_m) / grid.voxel_m,
        np.ascontiguousarray(directions[used]),
        ends_m[used] / grid.voxel_m,
        kind[used] == _VOTING,
        evidence.view_count,
        evidence.is_free,
        evidence.votes,
        evidence.last_view,
    )


def _classify_pixels(
    camera: PinholeCamera, matte: Float32[np.ndarray, "h w"]
) -> tuple[PinholeCamera, np.ndarray]:
    """The camera at ray resolution and what each ray does: carve, vote or nothing."""
    from scipy.ndimage import minimum_filter

    check_matte(camera, matte)
    small = camera.scaled(min(1.0, _RAY_WIDTH_PX / camera.width_px))
    masks = np.stack([matte >= SKY_ALPHA, matte <= SOLID_ALPHA], axis=-1)
    fractions = resize_area(masks.astype(np.float32), small.height_px, small.width_px) > 0.999
    size = 2 * _ERODE_PX + 1
    is_sky = np.asarray(minimum_filter(fractions[..., 0], size), bool)
    kind = np.full(is_sky.shape, _UNUSED)
    kind[fractions[..., 1]] = _VOTING
    kind[is_sky] = _CARVED
    return small, kind
