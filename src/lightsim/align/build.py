"""`align_log` estimates each correction in turn and accepts it only if held-back data improve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lightsim.align.cameras import CameraFit, align_cameras, chosen_frames
from lightsim.align.config import AlignConfig
from lightsim.align.gather import Gathered, gather
from lightsim.align.movers import settle_moving
from lightsim.align.path import PathFit, align_path
from lightsim.align.tracks import TrackFit, settle_parked
from lightsim.core.alignment import Alignment, PathCorrection
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame
from lightsim.progress import Progress

# The parts of the alignment are measured as a whole (docs/decisions/0004-alignment-stage.md); the
# sensitivity to each constant of this package is not measured.

# Fewest sweeps for a fit: one in four is held back, and planes need returns of several others.
_LEAST_SWEEPS = 6
# Fewest frames of a camera: one in four is held back for the acceptance test.
_LEAST_FRAMES = 4
# Rotation above which a correction gets a note of its own: twice the expected error of a mounting
# (0.15 degrees).
_LARGE_TURN_DEG = 0.3
# Translation above which a correction gets a note: more than a sensor shifts on a vehicle.
_LARGE_SHIFT_M = 0.1
# Frames of each camera that are compared with depth edges; bounds the time.
_CAMERA_FRAMES = 12


def align_log(
    log: DrivingLog, config: AlignConfig, *, rng: np.random.Generator, progress: Progress
) -> Alignment:
    """Estimate corrections of the ego path, the actor boxes and the cameras of a log.

    Args:
        log: the recorded log, without the frames and sweeps that evaluation holds out.
        config: parts to refine.
        rng: samples returns and depth edges.

    Returns:
        Corrections in frame `world`; parts that held-back data reject stay as recorded.
    """
    switched = Alignment(
        has_rolling_shutter=config.rolling_shutter,
        has_point_times=config.point_times,
        has_ego_vehicle_masks=config.ego_vehicle_masks,
    )
    log = switched.applied_to(log)
    needs_sweeps = config.lidar_poses or config.camera_poses or config.actor_tracks
    if needs_sweeps and len(log.sweeps) >= _LEAST_SWEEPS:
        return _aligned_by_sweeps(log, switched, config, rng, progress)
    notes: list[str] = []
    if needs_sweeps:
        notes.append(
            f"too few sweeps for the alignment: {len(log.sweeps)}, at least {_LEAST_SWEEPS} "
            "are required"
        )
    tracks = _settled_tracks(log, None, config, notes)
    actors = {fit.actor_id: fit.matrices for fit in tracks}
    return replace(switched, actors=actors, notes=tuple(notes))


def _aligned_by_sweeps(
    log: DrivingLog,
    switched: Alignment,
    config: AlignConfig,
    rng: np.random.Generator,
    progress: Progress,
) -> Alignment:
    """Return `switched` with all corrections that sweeps support."""
    notes: list[str] = []
    numbers: dict[str, float] = {}
    frames = _frames_to_compare(log, config)
    # Boxes are corrected relative to the corrected path, so the path comes first.
    stems = {frame.stem for some in frames.values() for frame in some}
    found = gather(log, stems, rng=rng, progress=progress)
    path = _aligned_path(log, found, config, rng, notes, numbers)
    correction = path.correction if path is not None and path.is_kept else None
    tracks = _settled_tracks(log, correction, config, notes)
    tracks += _moved_tracks(log, found, correction, config, rng, notes)
    fits = align_cameras(
        frames, log.cameras, found.edges_by_stem, log.ego, config, rng=rng, progress=progress
    )
    notes += [_camera_note(fit) for fit in fits]
    notes += large_notes(path, fits)
    for fit in fits:
        numbers[f"{fit.camera_name} edge score before"] = fit.score_before
        numbers[f"{fit.camera_name} edge score after"] = fit.score_after
    return replace(
        switched,
        path=correction,
        cameras={fit.camera_name: fit.correction for fit in fits if fit.is_kept},
        actors={fit.actor_id: fit.matrices for fit in tracks},
        numbers=numbers,
        notes=tuple(notes),
    )


def _frames_to_compare(log: DrivingLog, config: AlignConfig) -> Mapping[str, Sequence[CameraFrame]]:
    """Return frames of each camera that have a sweep; empty if cameras are not aligned."""
    if not config.camera_poses:
        return {}
    stems = {sweep.stem for sweep in log.sweeps}
    chosen = {
        name: chosen_frames(log.frames_of(name), stems, _CAMERA_FRAMES) for name in log.cameras
    }
    return {name: frames for name, frames in chosen.items() if len(frames) >= _LEAST_FRAMES}


def _aligned_path(
    log: DrivingLog,
    found: Gathered,
    config: AlignConfig,
    rng: np.random.Generator,
    notes: list[str],
    numbers: dict[str, float],
) -> PathFit | None:
    if not config.lidar_poses:
        return None
    fit = align_path(found.static, log.ego, config, rng, has_heights=log.has_heights)
    shifts_m, turns_deg = fit.shifts_m, fit.turns_deg
    numbers["path residual before, m"] = fit.residual_before_m
    numbers["path residual after, m"] = fit.residual_after_m
    numbers["path shift rms, m"] = _rms(shifts_m)
    numbers["path turn rms, deg"] = _rms(turns_deg)
    notes.append(
        f"path {_verdict(fit.is_kept)}: median distance of held-back sweeps from the other sweeps' "
        f"planes {1000 * fit.residual_before_m:.1f} -> {1000 * fit.residual_after_m:.1f} mm; "
        f"correction {100 * _rms(shifts_m):.1f} cm, {_rms(turns_deg):.3f} deg rms, "
        f"at most {100 * shifts_m.max():.1f} cm, {turns_deg.max():.3f} deg"
    )
    return fit


def _settled_tracks(
    log: DrivingLog, path: PathCorrection | None, config: AlignConfig, notes: list[str]
) -> list[TrackFit]:
    fits = settle_parked(log.actors, path) if config.actor_tracks else []
    if fits:
        notes.append(
            f"{len(fits)} parked boxes have one pose each; their labels jittered by "
            + _track_rms(fits)
        )
    return fits


def _moved_tracks(
    log: DrivingLog,
    found: Gathered,
    path: PathCorrection | None,
    config: AlignConfig,
    rng: np.random.Generator,
    notes: list[str],
) -> list[TrackFit]:
    if not config.actor_tracks:
        return []
    fits = settle_moving(log.actors, found.moving, path, config, rng)
    moving = sum(actor.is_moving and actor.kind.is_rigid_body for actor in log.actors)
    if moving:
        notes.append(
            f"{len(fits)} of {moving} moving boxes corrected: their returns agree better than with "
            f"the labels; correction {_track_rms(fits)}"
        )
    return fits


def _track_rms(fits: Sequence[TrackFit]) -> str:
    shift_cm = 100 * _rms([fit.shift_rms_m for fit in fits] or [0.0])
    return f"{shift_cm:.1f} cm, {_rms([fit.yaw_rms_deg for fit in fits] or [0.0]):.2f} deg rms"


def _rms(values: np.ndarray | list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _camera_note(fit: CameraFit) -> str:
    turn = np.degrees(np.linalg.norm(fit.correction.rotation_rad))
    shift = 100 * np.linalg.norm(fit.correction.shift_m)
    return (
        f"{fit.camera_name} {_verdict(fit.is_kept)}: {turn:.2f} deg, {shift:.1f} cm, "
        f"{1000 * fit.correction.time_offset_s:+.1f} ms; edge strength under held-back depth "
        f"edges {fit.score_before:.3f} -> {fit.score_after:.3f}"
    )


def large_notes(path: PathFit | None, fits: Sequence[CameraFit]) -> list[str]:
    """Return notes on corrections so large that the recorded calibration or poses may be wrong."""
    moved: list[tuple[str, str, float, float]] = []
    if path is not None and path.is_kept:
        turn_deg, shift_m = float(path.turns_deg.max()), float(path.shifts_m.max())
        moved.append(("the ego's path", "lidar_poses", turn_deg, shift_m))
    for fit in fits:
        if fit.is_kept:
            turn_deg = float(np.degrees(np.linalg.norm(fit.correction.rotation_rad)))
            shift_m = float(np.linalg.norm(fit.correction.shift_m))
            moved.append((fit.camera_name, "camera_poses", turn_deg, shift_m))
    return [
        f"large correction: {name} was rotated by up to {turn_deg:.2f} degrees and moved by up to "
        f"{100 * shift_m:.1f} cm; poses, calibration or intrinsics may be wrong "
        f"(--no-refine {part} leaves them as recorded)"
        for name, part, turn_deg, shift_m in moved
        if turn_deg > _LARGE_TURN_DEG or shift_m > _LARGE_SHIFT_M
    ]


def _verdict(is_kept: bool) -> str:
    return "corrected" if is_kept else "left as recorded"
