"""What grainy truth costs, and how far it lies from noise-free truth, with and without denoising.

    DRJIT_LIBLLVM_PATH=... python benchmarks/bench_grain.py [SEED] [--paths 16 24 48 96]
        [--reference 384]

One view of the small street (front camera, stem 03, low sun) beside one of 384 paths a pixel:
sRGB PSNR and LPIPS; `--reference 0` only takes the time. Needs the extra `denoise`; some five
minutes on one core.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from lightsim.build.quality.metrics import psnr
from lightsim.core.colour import srgb_from_linear
from lightsim.render.denoise import denoise
from lightsim_lab.metrics.lpips import lpips
from lightsim_lab.synthetic.generate import actor_poses_at, guides_at, street_tracer
from lightsim_lab.synthetic.plan import config_of, plan_street
from lightsim_lab.synthetic.rig import SWEEP_S, mount_cameras
from lightsim_lab.synthetic.skies import build_sky, sky_specs
from lightsim_lab.synthetic.street import build_street
from lightsim_lab.synthetic.writer import camera_pose

_STEM = 3
T = TypeVar("T")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("seed", type=int, nargs="?", default=631)
    parser.add_argument("--paths", type=int, nargs="+", default=[16, 24, 48, 96])
    parser.add_argument("--reference", type=int, default=384)
    options = parser.parse_args()
    config, plan = config_of("small"), plan_street(options.seed)
    street = build_street(plan, config.ego_speed_m_s)
    mounted = next(m for m in mount_cameras(plan, config) if m.camera.name == "front_camera")
    sky = next(build_sky(spec, plan) for spec in sky_specs(plan) if spec.name == "low_sun")
    time_s = SWEEP_S * _STEM + mounted.time_offset_s
    tracer = street_tracer(street, config, sky)
    tracer.place(actor_poses_at(street, time_s))
    pose = camera_pose(plan, config, mounted, time_s)

    def traced(paths: int) -> np.ndarray:
        return tracer.render(mounted.camera, mounted.margin_px, pose, paths, paths)

    def shown(radiance: np.ndarray) -> np.ndarray:
        return srgb_from_linear(np.clip(radiance * mounted.gain, 0, 1)).astype(np.float32)

    def scores(radiance: np.ndarray) -> str:
        if truth is None:
            return "-"
        return f"{psnr(shown(radiance), truth):.1f}, {lpips(shown(radiance), truth):.3f}"

    truth = shown(traced(options.reference)) if options.reference else None
    traced(1)  # Kernels are compiled.
    guides, guides_s = timed(lambda: guides_at(street, config, mounted, time_s))
    sys.stdout.write(f"{tracer.variant}; guides of a pose: {guides_s:.1f} processor s\n\n")
    sys.stdout.write("| paths | processor s | PSNR dB, LPIPS | denoised | processor s |\n")
    sys.stdout.write("|---:|---:|---:|---:|---:|\n")
    for paths in options.paths:
        made, paths_s = timed(lambda paths=paths: traced(paths))
        clean, s = timed(lambda made=made: denoise(made, guides.base_colour, guides.normal_world))
        row = f"{paths} | {paths_s:.1f} | {scores(made)} | {scores(clean)} | {s:.1f}"
        sys.stdout.write(f"| {row} |\n")
        sys.stdout.flush()


def timed(make: Callable[[], T]) -> tuple[T, float]:
    """What is made, and the processor seconds of all threads."""
    started = time.process_time()
    return make(), time.process_time() - started


if __name__ == "__main__":
    main()
