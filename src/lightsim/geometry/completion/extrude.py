"""Structures that no LiDAR beam reached but whose shadows matter: upper facades and roofs.

A LiDAR looks up some 15 degrees. What stands above an observed facade is inferred from the
images: rays through sky pixels prove free space, rays through pixels that show something no
reconstructed surface explains vote for matter (silhouette carving, Laurentini 1994,
doi:10.1109/34.273735, seeded by facades). The result casts shadows; it is a guess and is kept
apart from measured geometry.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.mesh import TriMesh
from lightsim.core.resample import resize_area
from lightsim.core.sensors import CameraFrame
from lightsim.errors import FrameMismatchError, InputError
from lightsim.geometry.completion.extrude_columns import (
    ColumnConfig,
    columns_from_facades,
    find_facades,
    free_in_front_of_walls,
)
from lightsim.geometry.completion.extrude_grid import VoxelEvidence, VoxelGrid
from lightsim.geometry.completion.extrude_kernels import walk_rays
from lightsim.geometry.completion.extrude_mesh import mesh_columns
from lightsim.progress import Progress

_LOWEST_RAY = -0.2
"""Vertical part of the steepest ray that is walked: below, only the road gets carved."""
_CARVED, _VOTING, _UNUSED = 0, 1, 2


@dataclass(frozen=True)
class ExtrudeConfig:
    """Settings of the inferred structures."""

    voxel_m: float = 0.5
    """Edge of a voxel; heights are found to about one voxel."""
    max_height_m: float = 40.0
    """Nothing is inferred higher than this above the lowest ground."""
    max_range_m: float = 80.0
    """Images vote for matter up to this distance from the camera; sky carves without limit."""
    ray_width_px: int = 320
    """Rays across an image."""
    sky_alpha: float = 0.8
    """A pixel of at least this alpha is sky."""
    solid_alpha: float = 0.2
    """A pixel of at most this alpha shows matter."""
    erode_px: int = 1
    """Rays this close to a pixel that is not sky do not carve."""
    surface_margin_m: float = 0.75
    """Free space ends this far in front of a reconstructed surface."""
    min_baseline_m: float = 0.7
    """Views of a camera that moved less than this since its last used view are skipped."""
    min_votes: int = 2
    """Views that must show matter in a voxel."""
    columns: ColumnConfig = field(default_factory=ColumnConfig)
    """What counts as a facade and how it is extended."""


def infer_tall_structures(
    background: TriMesh,
    silhouettes: Iterable[tuple[CameraFrame, PinholeCamera, Float32[np.ndarray, "h w"]]],
    config: ExtrudeConfig,
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
        config: settings.
        make_caster: builds the ray caster.
        progress: reporter.

    Raises:
        FrameMismatchError: the mesh is not in frame world.
        InputError: a matte does not fit its camera.
    """
    if background.frame != "world":
        raise FrameMismatchError(
            "the background lies in the wrong frame", got=background.frame, expected="world"
        )
    if len(background.faces) == 0:
        return mesh_columns([], VoxelGrid(np.zeros(3), config.voxel_m, (1, 1, 1)))
    grid = VoxelGrid.around(background, config.voxel_m, config.max_height_m)
    evidence = VoxelEvidence.empty(grid)
    caster = make_caster([background])
    last_position: dict[str, np.ndarray] = {}
    for frame, camera, matte in progress.track(silhouettes, "silhouettes"):
        position = frame.world_from_camera.translation_m
        last = last_position.get(frame.camera_name)
        if last is not None and np.linalg.norm(position - last) < config.min_baseline_m:
            continue
        last_position[frame.camera_name] = position
        _add_view(evidence, (frame, camera, matte), caster, config)
    free_in_front_of_walls(background, evidence, config.columns)
    facades = find_facades(background, grid, config.columns)
    columns = columns_from_facades(facades, evidence, config.min_votes, config.columns)
    return mesh_columns(columns, grid)


def _add_view(
    evidence: VoxelEvidence,
    view: tuple[CameraFrame, PinholeCamera, Float32[np.ndarray, "h w"]],
    caster: RayCaster,
    config: ExtrudeConfig,
) -> None:
    """Carve with the sky and with the seen surfaces of one view, vote with the unexplained."""
    frame, camera, matte = view
    small, kind = _classify_pixels(camera, matte, config)
    pose = frame.world_from_camera
    directions = pose.rotate(small.directions(small.pixel_centres())).reshape(-1, 3)
    origins = np.broadcast_to(pose.translation_m, directions.shape)
    hits = caster.intersect(np.ascontiguousarray(origins), directions)
    kind = kind.ravel().copy()
    # Nothing below the horizon can be sky or an upper storey, so it cannot vote.
    kind[(kind == _VOTING) & (directions[:, 2] < 0)] = _UNUSED
    is_seen = hits.is_hit & (kind != _CARVED)
    ends_m = np.where(kind == _CARVED, np.inf, config.max_range_m)
    ends_m[is_seen] = hits.distance_m[is_seen] - config.surface_margin_m
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
    camera: PinholeCamera, matte: Float32[np.ndarray, "h w"], config: ExtrudeConfig
) -> tuple[PinholeCamera, np.ndarray]:
    """The camera at ray resolution and what each ray does: carve, vote or nothing."""
    from scipy.ndimage import minimum_filter

    if matte.shape != (camera.height_px, camera.width_px):
        raise InputError(
            "the sky matte and the camera differ in size",
            where=f"camera '{camera.name}'",
            got=f"{matte.shape[1]}x{matte.shape[0]} px",
            expected=f"{camera.width_px}x{camera.height_px} px",
        )
    small = camera.scaled(min(1.0, config.ray_width_px / camera.width_px))
    masks = np.stack([matte >= config.sky_alpha, matte <= config.solid_alpha], axis=-1)
    shares = resize_area(masks.astype(np.float32), small.height_px, small.width_px) > 0.999
    size = 2 * config.erode_px + 1
    is_sky = np.asarray(minimum_filter(shares[..., 0], size), bool)
    kind = np.full(is_sky.shape, _UNUSED)
    kind[shares[..., 1]] = _VOTING
    kind[is_sky] = _CARVED
    return small, kind
