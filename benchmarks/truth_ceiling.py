"""PSNR that a noise-free, anti-aliased render of the true scene reaches on a street's pictures.

    python benchmarks/truth_ceiling.py WORK --seed 1 --size medium [--stem 20] [--samples 256]

Pictures of a synthetic log carry the path tracer's noise: no reconstruction can score higher.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from lightsim.build.quality.metrics import psnr
from lightsim.build.workspace import Workspace
from lightsim_lab.synthetic.generate import actor_poses_at
from lightsim_lab.synthetic.plan import config_of, plan_street
from lightsim_lab.synthetic.rig import SWEEP_S, mount_cameras
from lightsim_lab.synthetic.sensor import camera_isp
from lightsim_lab.synthetic.skies import build_sky, environment, sky_specs
from lightsim_lab.synthetic.street import build_street
from lightsim_lab.synthetic.tracer import PathTracer, Placed
from lightsim_lab.synthetic.writer import camera_pose


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--size", default="medium")
    parser.add_argument("--stem", type=int, default=20)
    parser.add_argument("--samples", type=int, default=256)
    options = parser.parse_args()
    config, plan = config_of(options.size), plan_street(options.seed)
    street, cameras = build_street(plan, config.ego_speed_m_s), mount_cameras(plan, config)
    sky = build_sky(sky_specs(plan)[0], plan)
    tracer = PathTracer(
        [part.transformed(plan.world_from_street) for part in street.background],
        [Placed(f"actor{i}", actor.parts) for i, actor in enumerate(street.participants)],
        street.finishes,
        environment(sky, config.environment_height_px),
        sky.sun,
    )
    work = Workspace(options.work)
    scores = []
    for mounted in cameras:
        time_s = SWEEP_S * options.stem + mounted.time_offset_s
        tracer.place(actor_poses_at(street, time_s))
        pose = camera_pose(plan, config, mounted, time_s)
        radiance = tracer.render(mounted.camera, mounted.margin_px, pose, options.samples, 987654)
        clean = camera_isp(radiance, mounted.gain, np.random.default_rng(0))
        frame = next(
            f for f in work.log.frames_of(mounted.camera.name) if int(f.stem) == options.stem
        )
        ego_vehicle = work.log.ego_vehicle_masks.get(frame.camera_name)
        valid = work.sky_matte(frame) < 0.5
        valid &= True if ego_vehicle is None else ~ego_vehicle
        score = psnr(
            clean.astype(np.float32) / 255, frame.load_srgb8().astype(np.float32) / 255, valid
        )
        scores.append(score)
        sys.stdout.write(f"{mounted.camera.name}: {score:.2f} dB\n")
    sys.stdout.write(f"mean: {np.mean(scores):.2f} dB\n")


if __name__ == "__main__":
    main()
