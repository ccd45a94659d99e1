"""Sky mattes of builds against what is known without looking: true geometry, or held-out sweeps.

    python benchmarks/sky_matte.py WORK [WORK ...]

Streets (truth/ beside the log), all frames: IoU at alpha 0.5, mean error of alpha, the fraction of
matter that passes for sky and of sky that does not, and the mean error within 8 pixels of the true
skyline. Recordings, frames held out: the fraction of held-out static returns that fall where alpha
is over 0.5, and of those that do so by more than 4 pixels (nearer, wires, roofs' edges and an error
of calibration decide); the fraction of surely open sky (`open_sky`) where it is not; and how much
is sky. Markdown, percent.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import distance_transform_edt, maximum_filter, maximum_filter1d, minimum_filter

from lightsim.build.workspace import Workspace
from lightsim.core.camera import PinholeCamera
from lightsim.core.lidar_returns import is_static
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.resample import resize_area
from lightsim.core.sensors import CameraFrame
from lightsim.render.casters.embree import make_embree_caster
from lightsim_lab.synthetic.reader import read_true_meshes

_SKYLINE_PX = 8
_REGISTERED_PX = 4
_RAYS_ACROSS = 3
"""Rays a pixel along each side, for a true alpha in tenths."""
_CLEAR_DEG = 3.0
_NEAR_M = 50.0
_WIRE_ROWS = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("works", type=Path, nargs="+")
    streets, recordings = [], []
    for path in parser.parse_args().works:
        work = Workspace(path, is_stale_allowed=True)
        truth = Path(work.reading.source).parent / "truth" / "scene.npz"
        if truth.is_file():
            streets.append((path.name, *_street_scores(work, read_true_meshes(truth))))
        else:
            recordings.append((path.name, *_recording_scores(work)))
    _print(("street", "IoU", "error", "false sky", "missed sky", "skyline error"), streets)
    names = ("recording", "returns in sky", "deep in it", "open sky missed", "sky")
    _print(names, recordings)


def _street_scores(work: Workspace, meshes: Mapping[str, TriMesh]) -> tuple[float, ...]:
    true_matte = true_mattes(work.recorded_log, meshes)
    found, true, near = [], [], []
    for frame in work.recorded_log.frames:
        alpha, size = true_matte(frame), 2 * _SKYLINE_PX + 1
        near.append(maximum_filter(alpha, size) - minimum_filter(alpha, size) > 0.5)
        found.append(work.sky_matte(frame))
        true.append(alpha)
    made, exact, is_near = np.stack(found), np.stack(true), np.stack(near)
    is_made, is_exact = made > 0.5, exact > 0.5
    error = np.abs(made - exact)
    return (
        float((is_made & is_exact).sum() / (is_made | is_exact).sum()),
        float(error.mean()),
        float(is_made[exact < 0.1].mean()),
        float((~is_made)[exact > 0.9].mean()),
        float(error[is_near].mean()),
    )


def true_mattes(
    log: DrivingLog, meshes: Mapping[str, TriMesh]
) -> Callable[[CameraFrame], Float32[np.ndarray, "h w"]]:
    """Alpha of a synthetic log's frames: the fraction of each pixel's rays that meet nothing.

    Args:
        log: the synthetic log.
        meshes: `read_true_meshes` of its truth.
    """
    background = make_embree_caster([meshes["background"]])
    tracks = [track for track in log.actors if track.actor_id in meshes]

    def true_matte(frame: CameraFrame) -> Float32[np.ndarray, "h w"]:
        camera = log.cameras[frame.camera_name]
        fine = camera.scaled(float(_RAYS_ACROSS))
        uv = fine.pixel_centres().reshape(-1, 2) / _RAYS_ACROSS
        origins, directions = frame.pixel_rays(camera, uv)
        present = [track for track in tracks if track.is_present(frame.time_ns)]
        poses = [track.world_from_actor(frame.time_ns) for track in present]
        placed = zip(present, poses, strict=True)
        actors = make_embree_caster([meshes[t.actor_id].transformed(pose) for t, pose in placed])
        is_open = ~background.is_occluded(origins, directions)
        is_open &= ~actors.is_occluded(origins, directions)
        rays = is_open.reshape(fine.height_px, fine.width_px, 1).astype(np.float32)
        return resize_area(rays, camera.height_px, camera.width_px)[..., 0]

    return true_matte


def _recording_scores(work: Workspace) -> tuple[float, ...]:
    log = work.recorded_log
    sweeps = [lazy.load() for lazy in log.sweeps if lazy.stem in work.held_out]
    held_out = np.concatenate([s.points_world[is_static(s, log.actors)] for s in sweeps])
    returns, top_deg = all_returns(log)
    in_sky, deep, missed, sky = [], [], [], []
    for frame in log.frames:
        if frame.stem in work.held_out:
            camera, is_sky = log.cameras[frame.camera_name], work.sky_matte(frame) > 0.5
            uv, is_seen = frame.project(camera, held_out)
            column, row = uv[is_seen].astype(np.int64).T
            in_sky.append(is_sky[row, column])
            deep.append(minimum_filter(is_sky, 2 * _REGISTERED_PX + 1)[row, column])
            missed.append(~is_sky[open_sky(frame, camera, returns, top_deg)])
            sky.append(is_sky.ravel())
    return tuple(float(np.concatenate(parts).mean()) for parts in (in_sky, deep, missed, sky))


def all_returns(log: DrivingLog) -> tuple[Float32[np.ndarray, "n 3"], float]:
    """Returns above the sensor of all sweeps, frame `world`, and the highest beam's elevation."""
    sweeps = [lazy.load() for lazy in log.sweeps]
    points_world = np.concatenate([sweep.points_world for sweep in sweeps])
    rise_m = points_world[:, 2] - np.concatenate([s.origins_world[:, 2] for s in sweeps])
    sines = rise_m / np.concatenate([sweep.distances_m for sweep in sweeps])
    # A few returns are of what the car carries.
    return points_world[rise_m > 0], float(np.degrees(np.arcsin(np.percentile(sines, 99.9))))


def open_sky(
    frame: CameraFrame,
    camera: PinholeCamera,
    returns_world: Float[np.ndarray, "n 3"],
    top_deg: float,
) -> Bool[np.ndarray, "h w"]:
    """Pixels that are surely sky, whatever they look like.

    What stands gives returns up to its top. A pixel below the highest beams is open where no return
    of any sweep lies within `_CLEAR_DEG`, wires at most are above it, and the nearest return is of
    something near: what is not there so high over a near roof is seldom anywhere behind it. (Far
    down a street, towers beyond the LiDAR's range are as silent as the sky.)
    """
    _, directions = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))
    distance_m = np.full((camera.height_px, camera.width_px), np.inf)
    elevation_deg = np.degrees(np.arcsin(directions[:, 2])).reshape(distance_m.shape)
    uv, is_seen = frame.project(camera, returns_world)
    column, row = uv[is_seen].astype(np.int64).T
    away_m = returns_world[is_seen] - frame.world_from_camera.translation_m
    distance_m[row, column] = np.linalg.norm(away_m, axis=1)
    has_hit = np.isfinite(distance_m)
    if not has_hit.any():
        return has_hit
    apart_px, nearest = distance_transform_edt(~has_hit, return_indices=True)  # type: ignore[misc]
    is_open = apart_px > np.tan(np.radians(_CLEAR_DEG)) * camera.fy
    is_open &= (elevation_deg > _CLEAR_DEG) & (elevation_deg < top_deg)
    is_open &= distance_m[tuple(nearest)] < _NEAR_M
    rows_above = np.cumsum(maximum_filter1d(has_hit, size=5, axis=1), axis=0)
    return is_open & (rows_above < _WIRE_ROWS)


def _print(names: tuple[str, ...], rows: list[tuple]) -> None:
    if rows:
        sys.stdout.write("| " + " | ".join(names) + " |\n|---" + "|---:" * (len(names) - 1) + "|\n")
    for name, *values in rows:
        cells = " | ".join(f"{100 * value:.3f}" for value in values)
        sys.stdout.write(f"| {name} | {cells} |\n")


if __name__ == "__main__":
    main()
