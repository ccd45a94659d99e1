"""What an ego vehicle that stands costs a twin: false surface, LiDAR error, masks and gains.

    lightsim synthesize --out S --seed 5 --paths 8 --denoise --standing stand
    lightsim build S/log --work W --hold-out 5 --image-scale 1 --until assets
    python benchmarks/standing_ego.py W --truth S/truth --standing stand

Prints, for each camera,

1. the percentage of static returns in its view that lie more than 1 m behind the mesh,
2. the IoU of the mask of the ego vehicle and its true pixels, at the first frame,
3. the largest error of its RGB gain, in percent,

and the error of held-out LiDAR beams that are cast again.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from lightsim.build.measures import lidar_error
from lightsim.build.workspace import Workspace
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayCaster
from lightsim.core.lidar_returns import is_static
from lightsim.core.sensors import CameraFrame, LazySweep
from lightsim.progress import SilentProgress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.artefact import read_json
from lightsim_lab.synthetic.generate import snapshot_at
from lightsim_lab.synthetic.plan import Standing, config_of, plan_street
from lightsim_lab.synthetic.rig import MountedCamera, mount_cameras, world_from_ego
from lightsim_lab.synthetic.street import Street, build_street

# Distance by which a return lies behind the mesh where the mesh is false, in metres.
_BEHIND_M = 1.0


@dataclass(frozen=True)
class Options:
    """Measure a twin of a street whose ego vehicle stands."""

    work: tyro.conf.Positional[Path]
    truth: Path
    standing: Standing = "stand"


def behind_percent(
    caster: RayCaster,
    work: Workspace,
    camera: PinholeCamera,
    pairs: list[tuple[CameraFrame, LazySweep]],
) -> float:
    """Return the percentage of static returns in view that lie behind the mesh."""
    count = behind = 0
    for frame, lazy in pairs:
        sweep = lazy.load()
        points = sweep.points_world[is_static(sweep, work.log.actors)].astype(np.float64)
        points = points[frame.project(camera, points)[1]]
        rays = points - frame.world_from_camera.translation_m
        distance_m = np.linalg.norm(rays, axis=1)
        origins = np.broadcast_to(frame.world_from_camera.translation_m, rays.shape).copy()
        hits = caster.intersect(origins, rays / distance_m[:, None])
        met_m = np.where(hits.is_hit, hits.distance_m, np.inf)
        count, behind = count + len(rays), behind + int((met_m < distance_m - _BEHIND_M).sum())
    return 100.0 * behind / max(count, 1)


def true_mask(street: Street, options: Options, mounted: MountedCamera) -> np.ndarray:
    """Return the pixels that show the ego vehicle's body."""
    config = replace(config_of("small"), standing=options.standing)
    camera = mounted.camera
    pose = world_from_ego(street.plan, config, 0.0) @ mounted.ego_from_camera
    snapshot = snapshot_at(street, config, 0.0)
    directions = pose.rotate(camera.directions(camera.pixel_centres().reshape(-1, 2)))
    origins = np.broadcast_to(pose.translation_m, directions.shape).copy()
    hits = snapshot.intersect(origins, directions)
    is_own = hits.is_hit & (snapshot.actor[hits.face] == len(street.participants))
    return is_own.reshape(camera.height_px, camera.width_px)


def main(options: Options) -> None:
    """Print the figures of every camera, and those of the LiDAR."""
    work = Workspace(options.work)
    facts = read_json(options.truth / "truth.json")
    plan = plan_street(facts["seed"])
    config = replace(config_of("small"), standing=options.standing)
    street = build_street(plan, config.ego_speed_m_s, is_standing=True)
    assets, log = work.assets, work.log
    caster = make_embree_caster([assets.background])
    scene = {lazy.stem: lazy for lazy in log.without_ego_returns().sweeps}
    sys.stdout.write("camera               behind 1 m %   mask IoU   gain error %" + "\n")
    for mounted in mount_cameras(plan, config):
        name = mounted.camera.name
        pairs = [(f, scene[f.stem]) for f in log.frames_of(name) if f.stem in scene]
        behind = behind_percent(caster, work, log.cameras[name], pairs)
        truth = true_mask(street, options, mounted)
        mask = log.ego_vehicle_masks.get(name, np.zeros_like(truth))
        union = int((truth | mask).sum())
        iou = f"{(truth & mask).sum() / union:8.3f}" if union else "       -"
        ratio = assets.camera_gains[name] / np.array(facts["camera_gains"][name])
        sys.stdout.write(
            f"{name:20} {behind:12.2f} {iou:>10} {100 * np.abs(ratio - 1).max():14.2f}" + "\n"
        )
    scores, _ = lidar_error(work, SilentProgress(), np.random.default_rng(0))
    sys.stdout.write(f"{scores}" + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
