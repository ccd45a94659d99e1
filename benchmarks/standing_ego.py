"""What an ego vehicle that stands costs: false surface, LiDAR error, masks and camera gains.

    lightsim synthesize --out S --seed 5 --paths 8 --denoise --standing stand
    python benchmarks/standing_ego.py S --standing stand [--work W]

Fuses the LiDAR of S/log with and without the returns on the ego vehicle; every fifth sweep is held
out. Prints for each

1. the percentage of the road within 4.5 m of the sensors where the mesh is more than 10 cm above or
   below it,
2. the error of held-out beams on static surfaces,
3. for each camera, the percentage of static returns in view more than 1 m behind the mesh;

then the IoU of each camera's mask with the true pixels of the ego vehicle, and, with the work
folder of a build, the error of its camera gains.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from lightsim.build.quality.geometry import evaluate_lidar
from lightsim.build.workspace import Workspace
from lightsim.core.casting import RayCaster
from lightsim.core.lidar_returns import is_static, points_on_ego
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.reading import LogReading
from lightsim.core.sensors import LazySweep
from lightsim.datasets.reader import read_log
from lightsim.geometry.mesh_scene import mesh_background
from lightsim.masks.ego_body import with_ego_body
from lightsim.masks.ego_vehicle import ego_vehicle_masks
from lightsim.progress import SilentProgress, terminal_progress
from lightsim.reconstruct.fusion.config import FuseConfig
from lightsim.reconstruct.fusion.tsdf import fuse_log
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.artefact import read_json
from lightsim_lab.synthetic.generate import snapshot_at
from lightsim_lab.synthetic.plan import Standing, StreetConfig, config_of, plan_street
from lightsim_lab.synthetic.rig import mount_cameras, world_from_ego
from lightsim_lab.synthetic.street import Street, build_street

# Distance by which a return lies behind the mesh where the mesh is false, in metres.
_BEHIND_M = 1.0
# Radius of the disc without ground returns, and largest error of its height, in metres.
_DISC_M, _LEVEL_M = 4.5, 0.1
# One sweep in so many is held out.
_HELD_OUT = 5


@dataclass(frozen=True)
class Options:
    """Measure a street whose ego vehicle stands."""

    street: tyro.conf.Positional[Path]
    standing: Standing = "stand"
    work: Path | None = None


def disc_percent(caster: RayCaster, street: Street, config: StreetConfig) -> float:
    """Return the percentage of the road around the ego vehicle where the mesh is elsewhere."""
    grid = np.arange(-_DISC_M, _DISC_M, 0.25)
    xy = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    # The kerb is 3.8 m from the middle of the lane.
    xy = xy[(np.hypot(*xy.T) < _DISC_M) & (np.abs(xy[:, 1]) < 3.5)]
    above = np.concatenate([xy, np.full((len(xy), 1), 3.0)], axis=1)
    origins = world_from_ego(street.plan, config, 0.0).apply(above)
    hits = caster.intersect(origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape).copy())
    return 100.0 * float(
        (np.abs(np.where(hits.is_hit, 3.0 - hits.distance_m, np.inf)) > _LEVEL_M).mean()
    )


def scene_sweep(log: DrivingLog, lazy: LazySweep) -> LazySweep:
    """Return the static returns of a sweep that are not on the ego vehicle."""
    sweep = lazy.load()
    chosen = is_static(sweep, log.actors)
    if log.ego_box is not None:
        chosen[points_on_ego(sweep, log.ego, log.ego_box)[0]] = False
    return replace(lazy, load=lambda: sweep.rows(chosen))


def behind_percent(
    caster: RayCaster, log: DrivingLog, name: str, scene: dict[str, LazySweep]
) -> float:
    """Return the percentage of static returns in a camera's view that lie behind the mesh."""
    count = behind = 0
    for frame in log.frames_of(name):
        points = scene[frame.stem].load().points_world.astype(np.float64)
        points = points[frame.project(log.cameras[name], points)[1]]
        origin = frame.world_from_camera.translation_m
        distance_m = np.linalg.norm(points - origin, axis=1)
        rays = (points - origin) / distance_m[:, None]
        hits = caster.intersect(np.broadcast_to(origin, rays.shape).copy(), rays)
        met_m = np.where(hits.is_hit, hits.distance_m, np.inf)
        count, behind = count + len(rays), behind + int((met_m < distance_m - _BEHIND_M).sum())
    return 100.0 * behind / max(count, 1)


def print_surface(
    title: str, mesh: TriMesh, found: DrivingLog, street: Street, config: StreetConfig
) -> None:
    """Print the figures of one mesh."""
    caster = make_embree_caster([mesh])
    scene = {lazy.stem: scene_sweep(found, lazy) for lazy in found.sweeps}
    held = tuple(scene.values())[_HELD_OUT - 1 :: _HELD_OUT]
    scores = evaluate_lidar(
        held, [mesh], lambda _: [], make_caster=make_embree_caster,
        rng=np.random.default_rng(0), progress=SilentProgress(),
    )  # fmt: skip
    disc = disc_percent(caster, street, config)
    sys.stdout.write(f"{title}: disc off the road {disc:.1f} %\n  {scores}\n")
    for name in found.cameras:
        behind = behind_percent(caster, found, name, scene)
        sys.stdout.write(f"  {name}: {behind:.2f} % behind the mesh\n")


def print_masks(found: DrivingLog, street: Street, config: StreetConfig) -> None:
    """Print the IoU of the masks with the true pixels at the first frame."""
    pose = world_from_ego(street.plan, config, 0.0)
    snapshot = snapshot_at(street, config, 0.0)
    for mounted in mount_cameras(street.plan, config):
        camera = mounted.camera
        directions = (pose @ mounted.ego_from_camera).rotate(
            camera.directions(camera.pixel_centres().reshape(-1, 2))
        )
        origin = (pose @ mounted.ego_from_camera).translation_m
        hits = snapshot.intersect(np.broadcast_to(origin, directions.shape).copy(), directions)
        truth = hits.is_hit & (snapshot.actor[hits.face] == len(street.participants))
        mask = found.ego_vehicle_masks.get(camera.name)
        made = np.zeros_like(truth) if mask is None else mask.reshape(-1)
        union = int((truth | made).sum())
        iou = f"{(truth & made).sum() / union:.3f}" if union else "none"
        sys.stdout.write(f"mask of {camera.name}: IoU {iou}\n")


def main(options: Options) -> None:
    """Print all figures."""
    facts = read_json(options.street / "truth" / "truth.json")
    config = replace(config_of("small"), standing=options.standing)
    plan = plan_street(facts["seed"])
    street = build_street(plan, config.ego_speed_m_s, is_standing=True)
    log = read_log(LogReading(source=str(options.street / "log")), ego_vehicle_masks)
    found = with_ego_body(log)
    for title, given in (("with ego returns", log), ("without", found.without_ego_returns())):
        train = tuple(s for i, s in enumerate(given.sweeps) if i % _HELD_OUT != _HELD_OUT - 1)
        fields = fuse_log(replace(given, sweeps=train), FuseConfig(), progress=terminal_progress())
        print_surface(title, mesh_background(fields, make_embree_caster), found, street, config)
    print_masks(found, street, config)
    if options.work is not None:
        for name, gain in Workspace(options.work).assets.camera_gains.items():
            error = 100 * (gain / np.array(facts["camera_gains"][name]) - 1)
            sys.stdout.write(f"gain of {name}: error {np.round(error, 1)} %\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
