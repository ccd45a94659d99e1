"""Cost of each further frame of a sequence under many skies; prints Markdown, asserts nothing.

    python benchmarks/rendering/sequence.py WORK [--camera front_camera] [--width 960] [--frames 40]
        [--skies 23] [--rays 32] [--images]

The light transport matrix as `lightsim render --what shaded,shadow` uses it at one sample a pixel,
or, with
--images, `--what image` at four with reflections; nothing is written. Camera and actors move.
Skies: the twin's own, turned by 15 degrees each.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

from lightsim.build.workspace import Workspace
from lightsim.render.options import RendererChoice
from lightsim.render.renderers import make_renderer
from lightsim.scenario.replay import replay


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--camera", default="front_camera")
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--skies", type=int, default=23)
    parser.add_argument("--rays", type=int, default=32)
    parser.add_argument("--images", action="store_true")
    options = parser.parse_args()
    workspace = Workspace(options.work)
    twin, log = workspace.twin, workspace.log
    frames = [f for f in log.frames if f.camera_name == options.camera][: options.frames]
    camera = log.cameras[options.camera]
    camera = camera.scaled(options.width / camera.width_px)
    samples = 4 if options.images else 1
    choice = RendererChoice(rays=options.rays, pixel_samples=samples)
    start = time.perf_counter()
    renderer = make_renderer(
        choice, twin.assets.background, workspace.unobserved_occluders, 0, has_images=options.images
    )
    dome = twin.sky.dome
    skies = [renderer.prepare(dome.rotated(15.0 * k)) for k in range(options.skies)]
    once = time.perf_counter() - start
    scenario = replay(twin, "benchmark", tuple(frames))
    rows, peak_mb = [], []
    for number, frame in enumerate(frames):
        clock, processor = time.perf_counter(), time.process_time()
        traced = renderer.trace(scenario, frame, camera)
        traced_s = time.process_time() - processor
        for sky in skies:
            if options.images:
                traced.image(sky)
            else:
                traced.light(sky)
        rows.append((time.perf_counter() - clock, time.process_time() - processor, traced_s))
        peak_mb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        sys.stderr.write(f"\r{number + 1}/{len(frames)}")
    first, rest = np.array(rows[0]), np.array(rows[1:])
    middle, worst = np.median(rest, axis=0), rest.max(axis=0)
    sys.stdout.write(
        f"\n{options.work.name}, {camera.width_px}x{camera.height_px}, {len(frames)} frames x"
        f" {len(skies)} skies, N={options.rays}, {'images' if options.images else 'light'};"
        f" static scene and skies {once:.1f} s\n\n"
        "| frame | seconds | processor seconds | of it tracing | peak MB so far |\n"
        "|---|---:|---:|---:|---:|\n"
        f"| first | {first[0]:.1f} | {first[1]:.1f} | {first[2]:.1f} | {peak_mb[0]:.0f} |\n"
        f"| further, median | {middle[0]:.1f} | {middle[1]:.1f} | {middle[2]:.1f} |"
        f" {peak_mb[len(peak_mb) // 2]:.0f} |\n"
        f"| further, worst | {worst[0]:.1f} | {worst[1]:.1f} | {worst[2]:.1f} |"
        f" {peak_mb[-1]:.0f} |\n"
    )


if __name__ == "__main__":
    main()
