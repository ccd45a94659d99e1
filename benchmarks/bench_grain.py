"""How far grainy truth lies from noise-free truth: few light paths, with and without denoising.

    DRJIT_LIBLLVM_PATH=... python benchmarks/bench_grain.py [SEED]

One view of the small street (front camera, stem 03, low sun) beside one of 384 paths a pixel:
sRGB PSNR and LPIPS. Needs the extra `denoise`; some ten minutes on one core.
"""

from __future__ import annotations

import sys

import numpy as np

from lightsim.core.colour import srgb_from_linear
from lightsim.evaluate.lpips import lpips
from lightsim.evaluate.metrics import psnr
from lightsim.synthetic.generate import actor_poses_at
from lightsim.synthetic.plan import config_of, plan_street
from lightsim.synthetic.rig import SWEEP_S, mount_cameras
from lightsim.synthetic.skies import build_sky, environment, sky_specs
from lightsim.synthetic.street import build_street
from lightsim.synthetic.tracer import PathTracer, Placed
from lightsim.synthetic.writer import camera_pose

_STEM, _REFERENCE = 3, 384


def main() -> None:
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 631
    config, plan = config_of("small"), plan_street(seed)
    street = build_street(plan, config.ego_speed_m_s)
    mounted = next(m for m in mount_cameras(plan, config) if m.camera.name == "front_camera")
    skies = {spec.name: build_sky(spec, plan) for spec in sky_specs(plan)}
    time_s = SWEEP_S * _STEM + mounted.time_offset_s
    poses = actor_poses_at(street, time_s)
    tracer = PathTracer(
        [part.transformed(plan.world_from_street) for part in street.background],
        [Placed(key, actor.parts) for key, actor in zip(poses, street.participants, strict=True)],
        street.finishes,
        environment(skies["low_sun"], config.environment_height_px),
        skies["low_sun"].sun,
    )
    tracer.place(poses)
    pose = camera_pose(plan, config, mounted, time_s)

    def picture(paths: int, *, is_denoised: bool) -> np.ndarray:
        radiance = tracer.render(
            mounted.camera, mounted.margin_px, pose, paths, paths, is_denoised=is_denoised
        )
        return srgb_from_linear(np.clip(radiance * mounted.gain, 0, 1)).astype(np.float32)

    truth = picture(_REFERENCE, is_denoised=False)
    sys.stdout.write("| paths | denoised | PSNR dB | LPIPS |\n|---:|---|---:|---:|\n")
    for paths in (24, 48, 96):
        for is_denoised in (False, True):
            made = picture(paths, is_denoised=is_denoised)
            row = f"{paths} | {is_denoised} | {psnr(made, truth):.1f} | {lpips(made, truth):.3f}"
            sys.stdout.write(f"| {row} |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
